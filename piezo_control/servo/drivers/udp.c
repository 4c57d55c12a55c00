/* SPDX-License-Identifier: Apache-2.0
 *
 * Driver of a finger that is reached by UDP, one datagram each way per sample.
 *
 * options: HOST:PORT, by default 127.0.0.1:9750.
 *
 * A datagram is 24 bytes in the byte order of the sender's machine: the word "PZG1" and a zero word, a number
 * (uint64) and a value (double). The servo sends a voltage (V); the finger applies it and answers at once with
 * the same number and the deflection (m) that it measured just before. piezo_read waits for that answer for
 * half a period at most, and ignores older ones.
 *
 * One servo leads a finger. Its numbers rise from 1 on, and the finger applies no voltage whose number is not above the
 * last one. Number 0 says from the servo that it lets go, and brings its last voltage once more; from the finger that
 * somebody else leads it. A servo that is silent for the finger's hold time has let go as well.
 *
 * Anybody may ask what the finger puts out: the word "PZG?" in place of "PZG1", and any number; the finger answers with
 * both and the voltage of now, which it neither changes nor holds for that. One that does not know the word gives no
 * answer, and has to be at rest when a servo begins.
 *
 * Datagrams get lost, and the voltage after some that were is further away than the servo's slew limit lets it go in a
 * sample. So the finger keeps that limit itself, in time, on its way to the last voltage that came.
 */
#define _GNU_SOURCE
#include "piezo_driver.h"

#include <errno.h>
#include <netdb.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

struct datagram {
  char word[8];
  uint64_t number;
  double value;
};

struct piezo_device {
  int socket;
  int64_t limit; /* ns to wait for an answer */
  uint64_t sent, received, asked;
  double voltage; /* sent last */
  int64_t sent_at; /* ns */
  char error[160];
};

static const char WORD[8] = "PZG1", ASKS[8] = "PZG?";
static const int ATTEMPTS = 3;
static const int64_t PATIENCE = 20000000; /* ns for each */

static int64_t now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int failed(piezo_device *device, const char *what) {
  snprintf(device->error, sizeof device->error, "%s: %s", what, strerror(errno));
  return PIEZO_FAILED;
}

int piezo_driver_abi(void) { return PIEZO_DRIVER_ABI; }

static int connected(const char *host, const char *port, char *error, size_t size) {
  struct addrinfo hints = {.ai_family = AF_UNSPEC, .ai_socktype = SOCK_DGRAM};
  struct addrinfo *found = NULL;
  int code = getaddrinfo(host, port, &hints, &found);
  if (code) {
    snprintf(error, size, "%s:%s: %s", host, port, gai_strerror(code));
    return -1;
  }
  int fd = socket(found->ai_family, found->ai_socktype | SOCK_CLOEXEC, found->ai_protocol);
  if (fd < 0 || connect(fd, found->ai_addr, found->ai_addrlen)) {
    snprintf(error, size, "%s:%s: %s", host, port, strerror(errno));
    if (fd >= 0) close(fd);
    fd = -1;
  }
  freeaddrinfo(found);
  return fd;
}

piezo_device *piezo_open(const char *options, double sample_time, char *error, size_t size) {
  char host[128] = "127.0.0.1";
  const char *port = "9750";
  const char *colon = strrchr(options, ':');
  if (*options) {
    if (!colon || colon == options || !colon[1] || (size_t)(colon - options) >= sizeof host) {
      snprintf(error, size, "options are '%s', must be HOST:PORT", options);
      return NULL;
    }
    memcpy(host, options, (size_t)(colon - options));
    host[colon - options] = 0;
    port = colon + 1;
  }
  int fd = connected(host, port, error, size);
  if (fd < 0) return NULL;
  piezo_device *device = calloc(1, sizeof *device);
  if (!device) {
    snprintf(error, size, "out of memory");
    close(fd);
    return NULL;
  }
  device->socket = fd;
  device->limit = (int64_t)(0.5e9 * sample_time);
  return device;
}

int piezo_write(piezo_device *device, double voltage) {
  struct datagram out = {.number = device->sent + 1, .value = voltage};
  memcpy(out.word, WORD, sizeof WORD);
  if (send(device->socket, &out, sizeof out, MSG_DONTWAIT) != (ssize_t)sizeof out) {
    /* Nobody listens (yet), or the queue is full: the reading will be missing, which the servo judges. */
    if (errno == ECONNREFUSED || errno == EAGAIN || errno == ENOBUFS) {
      device->sent_at = now();
      return PIEZO_NONE_IN_TIME;
    }
    return failed(device, "send");
  }
  device->sent = out.number;
  device->voltage = voltage;
  device->sent_at = now();
  return PIEZO_FRESH;
}

static void wait_for_datagram(piezo_device *device, int64_t limit) {
  struct pollfd wait = {.fd = device->socket, .events = POLLIN};
  struct timespec timeout = {.tv_sec = limit / 1000000000, .tv_nsec = limit % 1000000000};
  ppoll(&wait, 1, &timeout, NULL);
}

int piezo_applied(piezo_device *device, double *voltage) {
  for (int attempt = 0; attempt < ATTEMPTS; attempt++) {
    struct datagram out = {.number = ++device->asked}, in;
    memcpy(out.word, ASKS, sizeof ASKS);
    (void)!send(device->socket, &out, sizeof out, MSG_DONTWAIT);
    for (int64_t end = now() + PATIENCE;;) {
      ssize_t size = recv(device->socket, &in, sizeof in, MSG_DONTWAIT);
      if (size == (ssize_t)sizeof in && !memcmp(in.word, ASKS, sizeof ASKS) && in.number == device->asked) {
        *voltage = in.value;
        return PIEZO_FRESH;
      }
      if (size >= 0) continue;
      int64_t rest = end - now();
      if (rest <= 0 || (errno != EAGAIN && errno != EINTR)) break;
      wait_for_datagram(device, rest);
    }
  }
  return PIEZO_NONE_IN_TIME;
}

int piezo_read(piezo_device *device, struct piezo_reading *reading) {
  int64_t end = now() + device->limit;
  for (;;) {
    struct datagram in;
    ssize_t size = recv(device->socket, &in, sizeof in, MSG_DONTWAIT);
    if (size == (ssize_t)sizeof in && !memcmp(in.word, WORD, sizeof WORD) && in.number == device->sent &&
        in.number > device->received) {
      device->received = in.number;
      reading->deflection = in.value;
      reading->age = 1e-9 * (double)(now() - device->sent_at);
      return PIEZO_FRESH;
    }
    if (size == (ssize_t)sizeof in && !memcmp(in.word, WORD, sizeof WORD) && !in.number)
      snprintf(device->error, sizeof device->error, "somebody else leads this finger");
    if (size >= 0) continue;
    if (errno == ECONNREFUSED) {
      snprintf(device->error, sizeof device->error, "nobody answers at this address");
    } else if (errno != EAGAIN && errno != EINTR) {
      return failed(device, "recv");
    }
    int64_t rest = end - now();
    if (device->received == device->sent || rest <= 0) return PIEZO_NONE_IN_TIME;
    wait_for_datagram(device, rest);
  }
}

const char *piezo_error(piezo_device *device) { return device->error; }

void piezo_close(piezo_device *device) {
  struct datagram out = {.number = 0, .value = device->voltage};
  memcpy(out.word, WORD, sizeof WORD);
  if (device->sent) (void)!send(device->socket, &out, sizeof out, MSG_DONTWAIT);
  close(device->socket);
  free(device);
}
