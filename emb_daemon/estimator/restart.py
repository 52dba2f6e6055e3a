"""What an estimator takes over a restart, and how much less certain it is afterwards.

The resolver's zero is another after every power-on, so the contact angle survives as the clearance from the released position.
What friction, motor and stiffness were found to be stays; heat flows on while nobody looks.
"""

from math import exp

import numpy as np

from emb_daemon.effects import terms
from emb_daemon.estimator.paths import AFTER_A_RESTART, doubt_memory, ordinary_stop, pads_rise
from emb_daemon.estimator.records import PARAMETERS, STATE
from emb_daemon.estimator.unknown import (
    HOUSING_S,
    LEAST_SCALE,
    MOST_CREEP,
    MOST_SCALE,
    WINDING_S,
    add_creep,
    add_growth,
    add_rest,
    add_stiffness_jumps,
    add_torque_jumps,
    set_priors,
)
from emb_daemon.jit import Record, entry, njit, sq
from emb_daemon.models.alignment import EARLIEST, LATEST, SLOWEST
from emb_daemon.models.fusion import CONTACT, CREEPS, FAST, NOISE, STATES, copy_errors
from emb_daemon.models.lateness import SLOWEST_S
from emb_daemon.models.thermal import NODES, UNALTERED, heat_step
from emb_daemon.wire.contract import CYCLE_S

#: Largest heating of a disc while the daemon was off, K/s and K: hard braking from motorway speed.
_UNSEEN_K_PER_S, _UNSEEN_K = 5.0, 200.0
#: Time between two snapshots of a daemon that runs, s: the most that a restart loses.
SNAPSHOT_S = 10.0
#: Longest step when the heat flow meanwhile is simulated, s, and longest time that is simulated, s.
_STEP_S, _FOLLOWED_S = 5.0, 6 * 3600.0

#: Bounds of a plausible snapshot: a contact further from the calibration's than ten times what brakes reach, m; more than a
#: pad or disc survives, degC; growth beyond ten times that of an iron disc, m/K; heat of motor and housing over what the
#: largest force's current leaves for ever; errors beyond so many of their standard deviations.
_CONTACT_M, _COLDEST_C, _HOTTEST_C, _GROWTH_M_PER_K, _HEAT, _SIGMAS = 1e-3, -60.0, 1200.0, 2.6e-6, 4.0, 10.0

SNAPSHOT = np.dtype(
    [
        ("clearance", "f8"),
        ("clearance_sigma", "f8"),
        ("scale", "f8"),
        ("creep", "f8", (len(CREEPS),)),
        ("growth", "f8"),
        ("growth_start", "f8"),
        ("error", "f8", (STATES,)),
        ("covariance", "f8", (STATES, STATES)),
        ("winding", "f8"),
        ("housing", "f8"),
        ("delay", "f8"),
        ("lag", "f8"),
        ("filtered", "f8"),
        ("temperature_known", "?"),
        ("pads", "f8", (2, NODES)),
        ("disc", "f8"),
        ("history", "f8"),
        ("temperature_sigma", "f8"),
        ("history_sigma", "f8"),
        ("terms_memory", "f8", (terms.MOST,)),
    ],
    align=True,
)


@njit
def _copy_pads(to, pads):
    # ``to[:, :] = pads`` would allocate.
    for side in range(2):
        for node in range(NODES):
            to[side, node] = pads[side, node]


@entry(STATE, PARAMETERS, SNAPSHOT, returns=1)
def take_snapshot(s: Record, p: Record, snapshot: Record) -> bool:
    """Fill a SNAPSHOT from a STATE; False, and nothing changed, while contact is unknown or uncertain, or samples may be
    forged."""
    if not s.started or s.unknown or s.contact.lost or s.contested:
        return False
    snapshot.clearance = p.clearance + s.contact_angle - s.contact_anchor
    snapshot.clearance_sigma = s.covariance[CONTACT, CONTACT] ** 0.5
    snapshot.scale, snapshot.growth, snapshot.growth_start = s.scale, s.growth, s.growth_start
    for i in range(len(CREEPS)):
        snapshot.creep[i] = s.creep[i]
    copy_errors(snapshot.error, snapshot.covariance, s.error, s.covariance)
    snapshot.winding, snapshot.housing = s.winding, s.housing
    snapshot.delay, snapshot.lag, snapshot.filtered = s.alignment.delay, s.alignment.lag, s.lateness.filtered
    snapshot.temperature_known = s.temperature_known
    _copy_pads(snapshot.pads, s.pads)
    snapshot.disc, snapshot.history = s.disc, s.history
    snapshot.temperature_sigma, snapshot.history_sigma = s.temperature_sigma, s.history_sigma
    terms.store(p.effects.terms, s.effects.terms, snapshot.terms_memory)
    return True


@njit
def _widen(s, p):
    """The covariance of a start, with that of all changes that a brake may have seen."""
    set_priors(s.covariance, p)
    add_stiffness_jumps(s.covariance, p)
    add_torque_jumps(s.covariance, p)
    add_growth(s.covariance, p)
    add_creep(s.covariance)


def why_implausible(snapshot: Record, p: Record) -> str:
    """Fields of a SNAPSHOT that are impossible for a brake with PARAMETERS ``p``, by name; empty if there are none."""
    widest = np.zeros(1, STATE)[0]
    _widen(widest, p)
    prior, covariance = widest["covariance"], snapshot["covariance"]
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(np.where(spread > 0.0, spread, 1.0), np.where(spread > 0.0, spread, 1.0))
    possible = {
        "clearance": abs(snapshot["clearance"] - p["clearance"]) * p["gear_gain"] <= _CONTACT_M,
        "clearance_sigma": 0.0 <= snapshot["clearance_sigma"] * p["gear_gain"] <= _CONTACT_M,
        "scale": LEAST_SCALE <= snapshot["scale"] <= MOST_SCALE,
        "creep": np.all(np.abs(snapshot["creep"]) <= MOST_CREEP),
        "growth": abs(snapshot["growth"]) * p["gear_gain"] <= _GROWTH_M_PER_K,
        "covariance": np.all(np.abs(correlation) <= 1.0 + 1e-6) and np.linalg.eigvalsh(correlation)[0] > -1e-3,
        "error": np.all(snapshot["error"] ** 2 <= _SIGMAS**2 * (np.diag(prior) + np.diag(covariance))),
        "winding": 0.0 <= snapshot["winding"] <= _HEAT,
        "housing": 0.0 <= snapshot["housing"] <= _HEAT,
        "delay": -EARLIEST <= snapshot["delay"] <= LATEST,
        "lag": abs(snapshot["lag"]) <= SLOWEST,
        "filtered": 0.0 <= snapshot["filtered"] <= SLOWEST_S,
        "terms_memory": terms.is_possible(p["effects"]["terms"], snapshot["terms_memory"]),
    }
    for name in ("pads", "disc", "growth_start"):
        if snapshot["temperature_known"]:
            possible[name] = np.all((snapshot[name] >= _COLDEST_C) & (snapshot[name] <= _HOTTEST_C))
    possible["history"] = abs(snapshot["history"]) <= _HOTTEST_C
    for name in ("temperature_sigma", "history_sigma"):
        possible[name] = 0.0 <= snapshot[name] <= _HOTTEST_C
    return ", ".join(name for name, is_possible in possible.items() if not is_possible)


@njit
def unseen_heating(elapsed_s: float) -> float:
    """By how much (K) a disc may have been heated while nobody watched it."""
    return min(_UNSEEN_K_PER_S * elapsed_s, _UNSEEN_K)


@njit
def rest_unwatched(s: Record, p: Record, elapsed_s: float) -> None:
    """What is less certain after ``elapsed_s`` s in which nobody watched the brake."""
    for i in range(STATES):
        for own in (FAST, NOISE):
            s.covariance[own, i] = s.covariance[i, own] = 0.0
    s.error[FAST] = s.error[NOISE] = 0.0
    s.covariance[FAST, FAST] = 1.0
    s.covariance[NOISE, NOISE] = sq(p.torque_constant * p.current_sigma)
    add_rest(s.covariance, p, elapsed_s)
    doubt_memory(s, p, ordinary_stop(p, AFTER_A_RESTART), max(elapsed_s - SNAPSHOT_S, 0.0))
    s.winding *= exp(-elapsed_s / WINDING_S)
    s.housing *= exp(-elapsed_s / HOUSING_S)


@entry(STATE, PARAMETERS, SNAPSHOT, float)
def resume(s: Record, p: Record, snapshot: Record, elapsed_s: float) -> None:
    """Prepare a STATE that has seen nothing yet with a SNAPSHOT of ``elapsed_s`` seconds ago.

    Its first sample then starts it as usual, but from these values."""
    s.resumed = True
    s.clearance, s.clearance_sigma = snapshot.clearance, snapshot.clearance_sigma
    s.scale, s.growth, s.growth_start = snapshot.scale, snapshot.growth, snapshot.growth_start
    for i in range(len(CREEPS)):
        s.creep[i] = snapshot.creep[i]
    copy_errors(s.error, s.covariance, snapshot.error, snapshot.covariance)
    s.alignment.delay, s.alignment.lag, s.lateness.filtered = snapshot.delay, snapshot.lag, snapshot.filtered
    s.winding, s.housing = snapshot.winding, snapshot.housing
    terms.resume(s.effects.terms, snapshot.terms_memory, elapsed_s)
    if snapshot.temperature_known:
        _copy_pads(s.pads, snapshot.pads)
        s.disc, s.history = snapshot.disc, snapshot.history
        s.temperature_sigma = snapshot.temperature_sigma + unseen_heating(elapsed_s)
        s.history_sigma = snapshot.history_sigma
        s.rested_s = min(max(elapsed_s, CYCLE_S), _FOLLOWED_S)
    rest_unwatched(s, p, elapsed_s)


@njit
def follow_heat(s: Record, t: Record, m: Record) -> None:
    """Simulate the heat flow of the time since the snapshot, with the plates' present temperatures."""
    ambient = m.ambient if m.has_status else m.caliper
    before = s.disc
    s.disc = heat_step(
        t, s.pads, s.disc, m.inner_backplate, m.outer_backplate, ambient, 0.0, False, 0.0, s.rested_s, s.work, _STEP_S,
        UNALTERED,
    )  # fmt: skip
    # Cooling air and braking meanwhile are unknown; both effects vanish as the disc cools.
    s.temperature_sigma = min(s.temperature_sigma, _UNSEEN_K) * exp(-s.rested_s * t.disc_cooling / t.disc_heat_capacity)
    s.temperature_sigma += 0.3 * abs(before - s.disc)
    forgotten = exp(-s.rested_s / t.history_time)
    rise = pads_rise(s, t)
    s.history = forgotten * s.history + (1.0 - forgotten) * rise
    s.history_sigma *= forgotten
