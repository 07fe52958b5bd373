"""A slice of the fuzz run; the whole one is `python tests/fuzz.py --inputs 1000000`."""

import fuzz
from catalogue import public

INPUTS = 4000


def test_every_public_function_is_fuzzed():
    assert set(fuzz.SANE) == public()


def test_no_input_ends_in_a_panic_a_hang_or_an_untyped_error():
    assert fuzz.run(INPUTS, seed=20) == []
