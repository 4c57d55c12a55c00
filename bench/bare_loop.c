/* SPDX-License-Identifier: Apache-2.0
 *
 * A periodic loop that does nothing: sleep to shortly before each edge, spin to it, note how late it is.
 * usage: bare_loop PERIODS PERIOD_NS SPIN_NS PRIORITY; prints the share of periods begun within a tenth.
 */
#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

static long long now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * 1000000000LL + t.tv_nsec;
}

int main(int count, char **words) {
  if (count != 5) return 2;
  long long periods = atoll(words[1]), period = atoll(words[2]), spin = atoll(words[3]);
  struct sched_param priority = {.sched_priority = atoi(words[4])};
  if (priority.sched_priority) sched_setscheduler(0, SCHED_FIFO, &priority);
  mlockall(MCL_CURRENT);
  prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0);
  long long edge = now(), good = 0, served = 0;
  while (served < periods) {
    long long instant = now();
    edge += period;
    long long missed = (instant - edge + period / 2) / period;
    if (missed > 0) {
      edge += missed * period;
      served += missed;
    }
    if (edge - instant > spin) {
      long long wake = edge - spin;
      struct timespec t = {wake / 1000000000, wake % 1000000000};
      clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
    }
    while ((instant = now()) < edge) {
    }
    good += instant - edge <= period / 10;
    served++;
  }
  printf("%.6f\n", (double)good / (double)served);
  return 0;
}
