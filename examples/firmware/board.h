/* SPDX-License-Identifier: Apache-2.0 */
/* Included before finger_test.c (-include board.h), which then says how long a sample takes. */
#ifndef BOARD_H
#define BOARD_H

unsigned long board_clock(void); /* ticks of 25 MHz */

#define FINGER_CLOCK() board_clock()

#endif
