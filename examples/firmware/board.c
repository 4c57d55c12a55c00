/* SPDX-License-Identifier: Apache-2.0
 *
 * The least that a Cortex-M7 needs before main(), and a clock; for the board mps2-an500 as QEMU emulates it.
 */
#include <stdint.h>

#include "board.h"

#define CPACR (*(volatile uint32_t *)0xE000ED88)
#define TIMER0_CTRL (*(volatile uint32_t *)0x40000000)
#define TIMER0_VALUE (*(volatile uint32_t *)0x40000004)
#define TIMER0_RELOAD (*(volatile uint32_t *)0x40000008)

extern void _start(void); /* of the C library: clears .bss, calls main() and exit() */
extern void stack_top(void); /* no function: an address of board.ld */

static void reset(void)
{
    CPACR |= 0xFu << 20; /* the floating-point unit is off at reset */
    TIMER0_RELOAD = 0xFFFFFFFF;
    TIMER0_VALUE = 0xFFFFFFFF;
    TIMER0_CTRL = 1;
    _start();
}

static void fail(void)
{
    for (;;)
        ;
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    stack_top, reset, fail, fail,
};

unsigned long board_clock(void)
{
    return ~TIMER0_VALUE; /* it counts down */
}
