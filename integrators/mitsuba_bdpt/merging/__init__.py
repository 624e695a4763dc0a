"""Vertex merging (photon mapping) of SDS paths. A component.

`Passes` traces the photons of each pass of a render and returns a `merging.Merging`, the further strategy of
the kernel (`sds.PhotonStrategy`). `estimate` estimates the light that no other strategy samples.
"""

from .passes import Passes, why_not
from .undersampled import Guidable, Undersampled
from .unsampled import Estimate, Unsampled, estimate

__all__ = ["Estimate", "Guidable", "Passes", "Undersampled", "Unsampled", "estimate", "why_not"]
