"""What every test needs: the package imported first, then Mitsuba with a variant."""

import mitsuba_bdpt  # noqa: F401, I001  (chooses the LLVM library; must precede mitsuba)
import mitsuba as mi
import pytest

VARIANT = "llvm_ad_rgb"
mi.set_variant(VARIANT)


@pytest.fixture(autouse=True)
def _variant():
    """Give every test the same variant, whatever the one before it has set."""
    mi.set_variant(VARIANT)
