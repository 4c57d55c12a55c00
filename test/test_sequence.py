# SPDX-License-Identifier: Apache-2.0
"""Numbered samples: whatever comes in between, each is answered once and in order."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from piezo_control.profile import Profile, SampledSignal
from piezo_control.sequence import FIRST, NEW, REPEATED, STRAY, Sequence

strays = st.lists(st.integers(2, 2**64 - 1), max_size=3)


@given(st.lists(strays, min_size=1, max_size=40))
def test_strays_neither_count_nor_stop_the_count(between):
    sequence = Sequence()
    for number, wild in enumerate(between):
        for stray in wild:
            expected = {number: NEW, number - 1: REPEATED}.get(stray, STRAY)
            assert sequence.classify(stray) == (expected if number else STRAY)
        assert sequence.classify(number) == (NEW if number else FIRST)
        sequence.count(number)
        assert sequence.classify(number) == REPEATED


def test_a_number_that_no_float_holds_is_never_the_first_of_a_count():
    """2^64 - 1 came first, the next block of a profile ran out of integers, and the node ended."""
    sequence = Sequence(gaps=True)
    wild = [2**64 - 4, 2**64 - 3, 2**64 - 2, 2**64 - 1]
    assert [sequence.classify(n) for n in wild] == [STRAY] * 4
    assert not any(sequence.begins_anew(n) for n in wild)
    assert sequence.next == -1
    assert sequence.classify(2**53) == NEW
    SampledSignal(Profile([0.0, 1.0], [0.0, 1e-6], linear=True), 1e-4)[2**53]


def test_zero_begins_again():
    sequence = Sequence()
    for number in (0, 1, 2):
        sequence.count(number)
    assert sequence.classify(0) == FIRST


@given(st.integers(100, 10**9), st.lists(st.integers(1, 5), min_size=3, max_size=3))
def test_a_count_that_begins_anew_is_followed_where_numbers_may_be_left_out(before, steps):
    for gaps in (True, False):
        sequence = Sequence(gaps)
        sequence.count(before)
        numbers = list(np.cumsum(steps))
        sequence.begins_anew(2**64 - 1)  # another stray one in between is no beginning
        assert [sequence.begins_anew(int(n)) for n in numbers] == [False, False, gaps]
        assert sequence.classify(int(numbers[-1])) == (NEW if gaps else STRAY)


@given(st.lists(st.integers(1, 1000), max_size=40))
def test_where_only_the_newest_counts_numbers_may_be_left_out(steps):
    sequence = Sequence(gaps=True)
    number = 10
    assert sequence.classify(number) == NEW  # it may join at any time
    sequence.count(number)
    for step in steps:
        number += step
        assert sequence.classify(number) == NEW
        assert sequence.classify(2**64 - 1) == STRAY
        sequence.count(number)
        assert sequence.classify(number - 2) in (STRAY, FIRST)
