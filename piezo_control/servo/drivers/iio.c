/* SPDX-License-Identifier: Apache-2.0
 *
 * Driver of converters that Linux knows as IIO devices, by their files in sysfs.
 *
 * options: the file of the input and that of the output, apart by a blank, for instance
 *   /sys/bus/iio/devices/iio:device0/in_voltage0_raw /sys/bus/iio/devices/iio:device1/out_voltage0_raw
 *
 * Readings and voltages are in raw codes: `sensor_scale` of the servo is m per code, `amplifier_gain` V per
 * code, `sensor_zero` and `amplifier_zero` the codes of 0 m and 0 V: minus the `offset` in sysfs, such as the code in the
 * middle of a bipolar converter whose code 0 is its negative end. A read takes as long as the conversion, so a converter on I2C or SPI keeps some hundred to some
 * thousand samples a second; design the controller for that.
 */
#define _GNU_SOURCE
#include "piezo_driver.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <unistd.h>

struct piezo_device {
  int in, out;
  char error[160];
};

int piezo_driver_abi(void) { return PIEZO_DRIVER_ABI; }

static int failed(piezo_device *device, const char *what) {
  snprintf(device->error, sizeof device->error, "%s: %s", what, strerror(errno));
  return PIEZO_FAILED;
}

piezo_device *piezo_open(const char *options, double sample_time, char *error, size_t size) {
  (void)sample_time;
  const char *blank = strchr(options, ' ');
  if (!blank || blank == options || !blank[1]) {
    snprintf(error, size, "options are '%s', must be the files of input and output, apart by a blank", options);
    return NULL;
  }
  char *in = strndup(options, (size_t)(blank - options));
  piezo_device *device = calloc(1, sizeof *device);
  if (!in || !device) {
    snprintf(error, size, "out of memory");
    free(in);
    free(device);
    return NULL;
  }
  device->in = open(in, O_RDONLY | O_CLOEXEC);
  if (device->in < 0) snprintf(error, size, "%s: %s", in, strerror(errno));
  device->out = device->in < 0 ? -1 : open(blank + 1, O_RDWR | O_CLOEXEC);
  if (device->in >= 0 && device->out < 0 && errno == EACCES) device->out = open(blank + 1, O_WRONLY | O_CLOEXEC);
  if (device->in >= 0 && device->out < 0) {
    snprintf(error, size, "%s: %s", blank + 1, strerror(errno));
    close(device->in);
  } else if (device->out >= 0 && flock(device->out, LOCK_EX | LOCK_NB)) {
    snprintf(error, size, "%s: %s", blank + 1,
             errno == EWOULDBLOCK ? "another servo writes to it, only one may" : strerror(errno));
    close(device->in);
    close(device->out);
    device->out = -1;
  }
  free(in);
  if (device->out < 0) {
    free(device);
    return NULL;
  }
  return device;
}

static int code(int file, double *value) {
  char text[64];
  ssize_t size = pread(file, text, sizeof text - 1, 0);
  if (size < 0) return PIEZO_FAILED;
  text[size] = 0;
  char *end;
  *value = strtod(text, &end);
  return end == text ? PIEZO_NONE_IN_TIME : PIEZO_FRESH;
}

int piezo_applied(piezo_device *device, double *voltage) { return code(device->out, voltage); }

int piezo_read(piezo_device *device, struct piezo_reading *reading) {
  int status = code(device->in, &reading->deflection);
  reading->age = 0.0;
  return status == PIEZO_FAILED ? failed(device, "input") : status;
}

int piezo_write(piezo_device *device, double voltage) {
  char text[32];
  int size = snprintf(text, sizeof text, "%lld\n", llround(voltage));
  return pwrite(device->out, text, (size_t)size, 0) == size ? PIEZO_FRESH : failed(device, "output");
}

const char *piezo_error(piezo_device *device) { return device->error; }

void piezo_close(piezo_device *device) {
  close(device->in);
  close(device->out);
  free(device);
}
