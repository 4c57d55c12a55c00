/* SPDX-License-Identifier: Apache-2.0
 *
 * A driver of the servo: a shared library with these functions, C calling convention; piezo_applied may be left out.
 *
 * piezo_open and piezo_close are called outside the loop and may take their time. piezo_read and piezo_write
 * are called once each per sample from one real-time thread: no allocation, no lock, no wait beyond a part of
 * `sample_time`. After piezo_close, as after the end of the process, the hardware itself must bring the
 * voltage to rest: a driver cannot.
 */
#ifndef PIEZO_DRIVER_H
#define PIEZO_DRIVER_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PIEZO_DRIVER_ABI 1

enum piezo_status {
  PIEZO_FRESH = 0,        /* done: a sample that was not returned before, or the voltage is on its way out */
  PIEZO_NONE_IN_TIME = 1, /* no new sample, or no voltage taken, within the time limit; the servo holds the voltage that
                           * went out last, and gives up after its hold time */
  PIEZO_FAILED = 2        /* like every other value: the device is gone; piezo_error says why */
};

struct piezo_reading {
  double deflection; /* as the card measures it, in V, counts or m: `sensor_scale` of the servo makes m of it */
  double age;        /* s since it was taken, 0 if in this call; never negative */
};

typedef struct piezo_device piezo_device;

/* Returns PIEZO_DRIVER_ABI. */
int piezo_driver_abi(void);

/* Opens the device that `options` describes, for a loop of period `sample_time` (s). Returns NULL, and why in
 * `error` (at most `size` bytes with the final 0), if it cannot, as where somebody else has the device: two who write
 * to one output leap from the voltage of the one to that of the other. The output stays as it is. */
piezo_device *piezo_open(const char *options, double sample_time, char *error, size_t size);

/* May be left out. Puts what the output puts out now, in the card's unit, into `voltage` and returns PIEZO_FRESH; any
 * other value says that the card cannot tell. Never called between two samples, but after piezo_open, when the loop begins,
 * and where no voltage went out for so long that the hardware may have gone to rest by itself. From there the servo leads the
 * voltage to rest. The output of a card that does not tell must be at rest already, or it leaps there. */
int piezo_applied(piezo_device *device, double *voltage);

/* Takes a sample. */
int piezo_read(piezo_device *device, struct piezo_reading *reading);

/* Puts out a voltage, in the card's unit: `amplifier_gain` of the servo is V at the finger per unit, `amplifier_zero`
 * the card's output at 0 V. Where it returns anything but PIEZO_FRESH the output has to be what it was before.
 * The servo keeps its limits of voltage and slew in what it hands over here. What is lost behind this call, and a card that
 * starts again, only the hardware can keep from being a step: in its own timer's interrupt it goes towards the last voltage by no more than
 * slew limit times period. */
int piezo_write(piezo_device *device, double voltage);

/* Says what went wrong last; valid until the next call. */
const char *piezo_error(piezo_device *device);

/* Lets go of the device. */
void piezo_close(piezo_device *device);

#ifdef __cplusplus
}
#endif

#endif
