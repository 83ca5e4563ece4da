"""The variant of all fits here."""

import mitsuba as mi
import pytest


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")
