# Corrected by .ci/typings.py from the stubs of Mitsuba 3.9.1
from . import (
    guiding as guiding,
    integrators as integrators,
    integrators.common as integrators.common,
    integrators.direct_projective as integrators.direct_projective,
    integrators.prb as integrators.prb,
    integrators.prb_basic as integrators.prb_basic,
    integrators.prb_projective as integrators.prb_projective,
    integrators.prbvolpath as integrators.prbvolpath,
    integrators.volprim_rf_basic as integrators.volprim_rf_basic,
    largesteps as largesteps,
    loaders as loaders,
    loaders.ray_loader as loaders.ray_loader,
    optimizers as optimizers,
    projective as projective
)
from .guiding import (
    BaseGuidingDistr as BaseGuidingDistr,
    GridDistr as GridDistr,
    OcSpaceDistr as OcSpaceDistr,
    UniformDistr as UniformDistr
)
from .largesteps import LargeSteps as LargeSteps
from .loaders.ray_loader import (
    FlatSensor as FlatSensor,
    RayDataLoader as RayDataLoader
)
from .projective import ProjectiveDetail as ProjectiveDetail

