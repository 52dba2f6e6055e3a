"""Types of the fields of structs that are read from YAML files."""

from typing import Annotated

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]


def usual(size: float) -> Meta:
    """Usual size of a number that may be zero: at zero a relative step would be zero (`parameters`)."""
    return Meta(extra={"usual": size})


class Struct(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of everything that is read from YAML."""
