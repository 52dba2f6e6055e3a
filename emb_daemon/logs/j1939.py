"""SAE J1939 as DBC files describe it: parameter groups of any sender, and raw values that mean that there is no value."""

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

#: Mask of the sender's address in a 29-bit id, and the null address, which in DBC files means any sender.
SENDER, _NOBODY = 0xFF, 0xFE
#: Mask of the parameter group in a 29-bit id, of the octet in it that may be an addressee, and largest PDU format with which
#: it is one.
_GROUP, _ADDRESSEE, _ADDRESSED = 0x3FFFF00, 0xFF00, 0xEF
#: Least most significant octet of a raw value that is reserved, an error or not available (J1939-71).
_NO_VALUE = 0xFB


#: One id or an array of them.
_Ids = TypeVar("_Ids", int, np.ndarray)


def is_group(message: "Message") -> bool:
    """Whether a message of a DBC (cantools) is a parameter group and not one sender's."""
    return message.is_extended_frame and (message.protocol == "j1939" or message.frame_id & SENDER == _NOBODY)


def group_of(can_id: _Ids) -> _Ids:
    """The bits of 29-bit ids that identify the parameter group, without priority, addressee and sender."""
    return can_id & (_GROUP - _ADDRESSEE * ((can_id >> 16 & 0xFF) <= _ADDRESSED))


def known(signal: "Signal", values: np.ndarray | float) -> np.ndarray:
    """Values of a group's signal (cantools), NaN where there is none."""
    if signal.length < 8 or signal.is_signed or signal.is_float:
        return np.asarray(values, float)
    raw = (np.asarray(values, float) - signal.offset) / signal.scale
    return np.where(raw < (_NO_VALUE << signal.length - 8) - 0.5, values, np.nan)
