"""A sample in, an estimate out: the one place from which the estimator is run."""

from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, STATE, new_state
from emb_daemon.estimator.step import predict, step
from emb_daemon.jit import Array, Record, Records, entry, njit
from emb_daemon.wire.contract import CONTESTED, CYCLE_S, DEGRADED, FAULT, INIT, INVALID, RUNNING

_NOTHING = new_state()


@entry(Array(SAMPLE), int, Array(STATE), Array(PARAMETERS), Array(ESTIMATE))
def answer(samples: Records, count: int, states: Records, parameters: Records, estimates: Records) -> None:
    """Estimate ``samples[:count]``.

    ``states`` and ``parameters`` have one record for each corner, or one in all.
    """
    for number in range(count):
        corner = samples[number].corner
        forget_contested(states, corner % len(states), samples[number])
        answer_row(samples[number], states[corner % len(states)], parameters[corner % len(parameters)], estimates[number])


@njit
def forget_contested(states: Records, index: int, row: Record) -> None:
    """Start a STATE anew when two senders no longer contradict each other: nobody knows which of its samples were forged."""
    if row.reasons & CONTESTED:
        states[index].contested = True
    elif states[index].contested:
        states[index] = _NOTHING[0]


@njit
def answer_row(row: Record, state: Record, p: Record, estimate: Record) -> None:
    """Estimate one SAMPLE into one ESTIMATE."""
    estimate.time_ns = row.time_ns
    estimate.cycle = row.cycle
    estimate.elapsed_cycles = row.elapsed_cycles
    estimate.age_cycles = row.age_cycles
    estimate.late_ns = row.late_ns
    estimate.corner = row.corner
    estimate.counter = row.counter
    estimate.is_sample = not row.is_prediction
    if row.is_prediction:
        predict(state, p, row.age_cycles * CYCLE_S, estimate)
    else:
        step(state, p, row, estimate)
    estimate.reasons |= row.reasons
    if estimate.reasons & CONTESTED:
        estimate.mode, estimate.source = FAULT, INVALID
    elif not state.started:
        estimate.mode = INIT
    elif estimate.source == INVALID:
        estimate.mode = FAULT
    elif estimate.reasons and estimate.mode == RUNNING:
        estimate.mode = DEGRADED
