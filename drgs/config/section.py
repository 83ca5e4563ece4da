"""What sections of a configuration are made of: their base, and numbers with limits."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from drgs.core.constants import MAX_INT

Count = Annotated[int, Field(le=MAX_INT)]

Rate = Annotated[float, Field(le=10)]
"""A step of Adam is about as long as its rate: ten units of a logarithm or a logit go from next to
nothing to everything."""

Weight = Annotated[float, Field(ge=0, le=1e6)]
"""Of a term of the loss, beside terms of weight 1."""


class Section(BaseModel):
    """Frozen; unknown keys, infinities and silent conversions ("3" for 3) are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
