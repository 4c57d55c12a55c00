/* SPDX-License-Identifier: Apache-2.0
 *
 * The loop on a board: a timer's interrupt, once every FINGER_SAMPLE_TIME. The four functions that are only
 * declared here are the board's.
 */
#include <stdatomic.h>

#include "finger.h"

int adc_read(double *volts);  /* 0: a fresh reading; else none came */
void dac_write(double volts); /* through the amplifier to the finger */
void watchdog_kick(void);     /* without it the hardware takes the voltage to rest by itself */
int emergency_stop(void);

static finger_state finger;
static _Atomic float reference; /* m; the main loop writes it, a float is written whole */
static atomic_int wants_reset;

void loop_begin(void)
{
    finger_init(&finger);
    dac_write(FINGER_AMPLIFIER_ZERO + finger.voltage / FINGER_AMPLIFIER_GAIN);
}

void loop_refer(float metres)
{
    reference = metres;
}

/* The main loop reports finger.cause and asks for this when a person says so. */
void loop_reset(void)
{
    wants_reset = 1;
}

void timer_interrupt(void)
{
    double volts = 0;
    const int status = adc_read(&volts) == 0 ? FINGER_FRESH : FINGER_NONE_IN_TIME;

    if (atomic_exchange(&wants_reset, 0) && finger.phase == FINGER_FAULT)
        finger_reset(&finger);
    if (emergency_stop())
        finger_stop(&finger);
    dac_write(FINGER_AMPLIFIER_ZERO + finger_step(&finger, status, volts, reference) / FINGER_AMPLIFIER_GAIN);
    watchdog_kick();
}
