"""SAE J1939 as DBC files describe it: parameter groups, whoever sends them, and values that say that there is none."""

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

#: Sender's address in a 29-bit id, and the one that nobody has, by which DBC files mean any.
SENDER, _NOBODY = 0xFF, 0xFE
#: Parameter group in a 29-bit id, the octet in it that is an addressee instead, and PDU format up to which it is.
_GROUP, _ADDRESSEE, _ADDRESSED = 0x3FFFF00, 0xFF00, 0xEF
#: First octet of a parameter from which it is no value: reserved, an error or not available (J1939-71).
_NO_VALUE = 0xFB


#: One id or an array of them.
_Ids = TypeVar("_Ids", int, np.ndarray)


def is_group(message: "Message") -> bool:
    """Whether a message of a DBC (cantools) is a parameter group and not one sender's."""
    return message.is_extended_frame and (message.protocol == "j1939" or message.frame_id & SENDER == _NOBODY)


def group_of(can_id: _Ids) -> _Ids:
    """Of a 29-bit id, or an array of them, what says the parameter group: neither priority nor addressee nor sender."""
    return can_id & (_GROUP - _ADDRESSEE * ((can_id >> 16 & 0xFF) <= _ADDRESSED))


def known(signal: "Signal", values: np.ndarray | float) -> np.ndarray:
    """Values of a group's signal (cantools), NaN where it says that there is none."""
    if signal.length < 8 or signal.is_signed or signal.is_float:
        return np.asarray(values, float)
    raw = (np.asarray(values, float) - signal.offset) / signal.scale
    return np.where(raw < (_NO_VALUE << signal.length - 8) - 0.5, values, np.nan)
