"""A daemon's broadcasts for Prometheus (text exposition format 0.0.4). Values that are not to be used are left out."""

from collections.abc import Iterable

from emb_daemon.monitor.listener import Listener
from emb_daemon.wire.contract import MODES, REASONS, SOURCES, STATUSES

_TEMPERATURES = ("inner_surface", "inner_mean", "outer_surface", "outer_mean")

#: Gauges: name, description, and value from `Corner.state`.
_GAUGES = {
    "emb_clamp_force_newtons": ("Clamp force", lambda state: _times(state["clamp_force_kN"], 1e3)),
    "emb_clamp_force_sigma_newtons": ("One standard deviation", lambda state: _times(state["clamp_force_sigma_kN"], 1e3)),
    "emb_stiffness_factor": ("Stiffness relative to the calibration", lambda state: state["stiffness_factor"]),
    "emb_contact_angle_radians": ("Motor angle at which the pads touch", lambda state: state["contact_angle_rad"]),
    "emb_input_age_seconds": (
        "Age of the sample from which the force was estimated",
        lambda state: _times(state["input_age_ms"], 1e-3),
    ),
    "emb_silent_seconds": ("Time since the last good frame", lambda state: state["silent_s"]),
    "emb_forces_per_second": ("Clamp forces received in the last second", lambda state: state["forces_per_s"]),
}
_COUNTERS = {
    "emb_frames_received_total": ("Good frames", "received"),
    "emb_frames_missing_total": ("Missing frames, by the E2E counter", "missing"),
    "emb_frames_damaged_total": ("Frames with a wrong CRC or a repeated counter", "damaged"),
}
_WORDS = {
    "emb_mode": ("Mode of the estimator", "mode", MODES),
    "emb_source": ("Source of the clamp force", "source", tuple(SOURCES.values())),
    "emb_status": ("Whether the clamp force may be used", "status", tuple(STATUSES.values())),
}


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _family(name: str, kind: str, about: str, rows: Iterable[tuple[str, float | None]]) -> list[str]:
    samples = [f"{name}{{{labels}}} {value:.9g}" for labels, value in rows if value is not None]
    return [f"# HELP {name} {about}.", f"# TYPE {name} {kind}", *samples] if samples else []


def exposition(listener: Listener, now_ns: int) -> str:
    """Every corner from which broadcasts were received, at a time on the monotonic clock."""
    states = [(f'corner="{name}"', state) for name, state in listener.states(now_ns).items()]
    lines: list[str] = []
    for name, (about, value) in _GAUGES.items():
        lines += _family(name, "gauge", about, ((corner, value(state)) for corner, state in states))
    rows = ((f'{corner},place="{place}"', state[f"{place}_C"]) for corner, state in states for place in _TEMPERATURES)
    lines += _family("emb_pad_temperature_celsius", "gauge", "Pad temperature", rows)
    for name, (about, field, words) in _WORDS.items():
        rows = ((f'{corner},{field}="{word}"', float(state[field] == word)) for corner, state in states for word in words)
        lines += _family(name, "gauge", about, rows)
    rows = ((f'{corner},reason="{word}"', float(word in state["reasons"])) for corner, state in states for word in REASONS)
    lines += _family("emb_reason", "gauge", "Whether the estimate is degraded for this reason", rows)
    for name, (about, field) in _COUNTERS.items():
        lines += _family(name, "counter", about, ((corner, state[field]) for corner, state in states))
    return "\n".join([*lines, ""])
