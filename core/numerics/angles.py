"""Units of angle, and the width of a Gaussian."""

import math

ARCMIN = math.pi / 10800
"""rad."""
ARCSEC = math.pi / 648000
"""rad."""
FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
"""Full width at half maximum of a Gaussian of unit standard deviation."""
