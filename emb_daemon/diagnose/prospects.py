"""Which forms of the grammar are worth a fit: screened on episodes left out of it, beside all that a path's own parameters can
do, and the best few run through the estimator."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np

from emb_daemon.calibration.terms import Term, fill_terms
from emb_daemon.diagnose.coordinates import Coordinate, Move
from emb_daemon.diagnose.evidence import Averaging, Evidence
from emb_daemon.diagnose.forms import FORMED, Form, enumerate_forms, enumerate_products, harmonic, rippling
from emb_daemon.diagnose.model import LASTING, Model, noise_left
from emb_daemon.diagnose.orders import strongest_orders
from emb_daemon.diagnose.residuals import Bench, Probe
from emb_daemon.diagnose.selection import NOT_OF_A_FREE_MOTOR
from emb_daemon.diagnose.signals import OF_A_BRAKE
from emb_daemon.effects.base import HOOKS, Effect, Harmonic, Parameter
from emb_daemon.effects.terms import MOST, PARAMETERS, PORTS, SIGNALS, evaluate
from emb_daemon.errors import InvalidValue

#: Samples that are averaged for chance, which asks all forms a hundred times, and for whether anything slow is left.
COARSE = 32
#: Forms that are run through the estimator.
_SHORTLIST = 10
#: Forms whose sizes are fitted before that, and tries for each size: exponents and times as enumerated are a factor of two and
#: more apart, and between two signals that resemble each other the better guess of an exponent would decide.
_SHARPENED, _TRIES = 24, 8
#: Share of the best gain from which another port or signal is as good, and from which it may be once its sizes are fitted.
AS_GOOD, NEARLY = 0.95, 0.9
#: Signals at their ports that are multiplied by others: what says nothing alone rarely does in a product (weak heredity,
#: Chipman, Canadian J. Statistics 24, 1996).
_LEADING = 10
#: Shifts of all signals in time, and of the chosen one's.
CHANCES, SHIFTS = 99, 5
#: Share of the samples in which a term must stay within what its port may bear.
_HELD = 0.9
#: Sum of squares up to which it is nothing, as that of a regressor that decays: a quotient by less would overflow.
NOTHING = 1e-200
#: Orders of ripples that are scanned, and how many of the strongest are run through the estimator.
_ORDERS, _LOBES = (0.05, 100.0), 4


@dataclass(frozen=True)
class Scores:
    """What left-out episodes say of forms, one row each: with ``u`` = xᵀr and ``a`` = xᵀx of each episode, nuisances projected
    out of the regressor x."""

    u: np.ndarray
    a: np.ndarray

    @property
    def fall(self) -> np.ndarray:
        """Fall of the squared error of each left-out episode."""
        rest = self.a.sum(axis=1, keepdims=True) - self.a
        told = rest > NOTHING
        without = np.divide(self.u.sum(axis=1, keepdims=True) - self.u, rest, out=np.zeros_like(rest), where=told)
        return 2.0 * without * self.u - without**2 * self.a

    @property
    def gain(self) -> np.ndarray:
        """The same summed over them."""
        return np.sum(self.fall, axis=1)


class Screen:
    """One channel's residual, averaged, with its nuisances, against which forms are held."""

    def __init__(self, model: Model, channel: str, samples: int):
        self.model = model
        self.channel = channel
        bench = model.bench
        self.means: Averaging = bench.means(channel, samples)
        self._bounds = np.searchsorted(self.means.episode, np.arange(bench.episodes + 1))
        own = model.movable(channel)
        penalty = model.penalty(own, channel) + 1e-12
        table = np.column_stack([*(model.columns[c] for c in own), model.residual[channel]])
        averaged = self.means.of(table)
        self.nuisances: np.ndarray = averaged[:, :-1]
        self._inverse = np.linalg.pinv(self.nuisances.T @ self.nuisances + np.diag(penalty), rcond=1e-12, hermitian=True)
        self.residual: np.ndarray = self.beside_nuisances(averaged[:, -1:])
        self.keep: np.ndarray = model.residual[channel] != 0.0

    @property
    def noise_scatter(self) -> float:
        """Relative standard deviation of the squared error that noise leaves."""
        return float(np.sqrt(2.0 / max(np.count_nonzero(self.means.per_mean), 1)))

    def beside_nuisances(self, averaged: np.ndarray) -> np.ndarray:
        """What of averaged columns the nuisances cannot take."""
        return averaged - self.nuisances @ (self._inverse @ (self.nuisances.T @ averaged))

    def scores(self, columns: np.ndarray) -> Scores:
        """Of regressors (N, k)."""
        return self.scores_of(self.means.of(columns * self.keep[:, None]))

    def contribution(self, prospect: "Prospect") -> np.ndarray:
        """What a form of its size takes from the averaged residual."""
        columns = self.beside_nuisances(self.means.of(np.column_stack(prospect.columns) * self.keep[:, None]))
        return columns @ prospect.evidence.values

    def scores_of(self, averaged: np.ndarray) -> Scores:
        """Of regressors that are averaged already."""
        taken = self._inverse @ (self.nuisances.T @ averaged)
        u, a = np.empty((2, len(self._bounds) - 1, averaged.shape[1]))
        # An episode at a time stays in the processor's cache.
        for index, (begin, end) in enumerate(pairwise(self._bounds)):
            left = averaged[begin:end] - self.nuisances[begin:end] @ taken
            u[index], a[index] = self.residual[begin:end, 0] @ left, np.einsum("ij,ij->j", left, left)
        return Scores(u.T, a.T)


@dataclass(frozen=True)
class Prospect:
    """A form with its regressors, by the estimator itself, and what left-out episodes say of them."""

    form: Form
    columns: list[np.ndarray]
    evidence: Evidence

    @property
    def means(self) -> tuple[str, str]:
        """What it says: port and signals."""
        return self.form.means


class Search:
    """All forms at the ports of one channel; none where the calibration has no room for a term."""

    def __init__(self, model: Model, channel: str, signals: list[np.ndarray]):
        self.model = model
        self.channel = channel
        self.signals = signals
        self.random: np.random.Generator = np.random.default_rng(0)
        covered = covered_by(np.concatenate(signals))
        self.covered: dict[str, tuple[float, float]] = {
            name: reach for name, reach in covered.items() if model.bench.clamps or name not in OF_A_BRAKE
        }
        self.ports: tuple[str, ...] = tuple(
            port
            for port in PORTS
            if port in FORMED
            and free_place(model) is not None
            and model.bench.channel_of(HOOKS[port].channel) == channel
            and not (port == NOT_OF_A_FREE_MOTOR and model.bench.turns_free)
        )
        self.sensitivities: dict[str, np.ndarray] = {port: _sensitivity(model, channel, port) for port in self.ports}
        self.screen: Screen = Screen(model, channel, LASTING[channel])

    @cached_property
    def forms(self) -> list[Form]:
        """All of one signal but ripples. Where nothing is clamped neither direction is closing: friction is odd in speed."""
        every = enumerate_forms(self.covered, self.ports)
        return [form for form in every if form.gate == "always" or self.model.bench.clamps]

    @cached_property
    def gains(self) -> np.ndarray:
        """What left-out episodes gain by each of them."""
        return self._find_gains(self.forms)

    @cached_property
    def products(self) -> list[Form]:
        """Those of two signals, one of which leads alone."""
        best: dict[tuple[str, str], float] = {}
        for form, gain in zip(self.forms, self.gains, strict=True):
            best[form.port, form.signal] = max(gain, best.get((form.port, form.signal), 0.0))
        leading = set(sorted(best, key=best.__getitem__)[-_LEADING:])
        every = enumerate_products(self.covered, self.ports)
        return [form for form in every if any((form.port, signal) in leading for signal in form.signals)]

    @cached_property
    def product_gains(self) -> np.ndarray:
        """What left-out episodes gain by each of those."""
        return self._find_gains(self.products)

    def answer(self, form: Form) -> np.ndarray:
        """What a form of coefficient one does to the channel."""
        return self.sensitivities[form.port] * _values(self.model.bench, form, self.signals)

    def over(self, form: Form) -> np.ndarray:
        """The signal that a form shapes, at every sample, shape (N,)."""
        return np.concatenate(self.signals)[:, list(SIGNALS).index(form.signal)]

    def _find_gains(self, forms: Sequence[Form]) -> np.ndarray:
        return _screen_forms(self.screen, forms, self.sensitivities, self.signals).gain

    def ripples(self) -> list[Prospect]:
        """The strongest ripples over the motor angle at each port that may have one, through the estimator."""
        return self._run(_ripples(self))

    def _run(self, forms: Sequence[Form]) -> list[Prospect]:
        columns = [_find_regressors(self.model, self.channel, form) for form in forms]
        found = [self.model.evidence(self.channel, own, samples=LASTING[self.channel]) for own in columns]
        return [Prospect(*one) for one in zip(forms, columns, found, strict=True)]

    def prospects(self, floor: float = 0.0) -> list[Prospect]:
        """The best forms, through the estimator, with their sizes fitted; shortest description first. Of two signals only
        where one leaves more than ``floor`` (RMS, in the channel's unit) that lasts, and if the best is one of them."""
        if not self.ports:
            return []
        model, samples = self.model, LASTING[self.channel]
        noise = float(noise_left(model, self.channel, samples).sum())
        alone, least = float(model.left_out(self.channel, samples=samples).sum()) - noise, noise * self.screen.noise_scatter

        def shortest(found: Sequence[Prospect]) -> list[Prospect]:
            kept = [p for p in found if p.evidence.gain > 0.0 and _stays_in_bounds(p) and self.is_within(_term_of(p))]
            # The noise is an estimate, which may be more than the best leaves: all would leave nothing.
            most = max((p.evidence.gain for p in kept), default=0.0)
            return sorted(kept, key=lambda p: _length(p, max(alone, most + least), model.bench.episodes))

        own = self._lasting(range(len(self.forms)))
        single = shortest([*self._run(_sharpen(self, [self.forms[i] for i in own], self.gains[own])), *self.ripples()])
        most = max((p.evidence.gain for p in single), default=0.0)
        if model.rms(alone - most, self.channel) <= floor:
            return single
        every = shortest([*single, *self._run(_sharpen(self, self.products, self.product_gains))])
        return every if every and every[0].form.other else single

    def _lasting(self, indices: Iterable[int]) -> list[int]:
        """Those of the forms of one signal that can be a term; the others count for what chance does. A brake's motor angle
        begins anywhere at each power-on, so that a place along it is another one in the next log; its travel counts from the
        contact. A machine that clamps nothing has no contact, and only its angle."""
        return [i for i in indices if not (_is_place(self.forms[i]) and self.model.bench.clamps)]

    def is_within(self, term: Term) -> bool:
        """Whether a term that the kernel holds within its limits would stay there on these logs anyhow: one at its limit
        more often is a constant there, and its shape says something else."""
        if not term.is_held:
            return True
        values = _evaluate(self.model.bench, _unheld(term), self.signals)
        return bool(np.quantile(np.maximum(-values / term.limit, values / term.growth), _HELD) <= 1.0)

    def of_means(self, port: str, signals: tuple[str, ...]) -> list[Prospect]:
        """The best forms of some signals at a port, through the estimator."""
        every, gains = self.forms, self.gains
        if len(signals) > 1:
            every, gains = self.products, self.product_gains
        own = [index for index, form in enumerate(every) if form.port == port and {*form.signals} == {*signals}]
        own = own if len(signals) > 1 else self._lasting(own)
        return self._run(_sharpen(self, [every[index] for index in own], gains[own])) if own else []

    def undecided(self, best: Prospect, rivals: Sequence[Prospect]) -> float:
        """Largest RMS by which a rival does otherwise than the best, beside all that the path's parameters can do."""
        does = [self.screen.contribution(prospect) for prospect in (best, *rivals)]
        return max((self.model.rms(float(np.square(does[0] - other).sum()), self.channel) for other in does[1:]), default=0.0)

    def chance(self, best: Prospect) -> float:
        """That of the best among all forms, with two signals if it has two; a ripple's is that of its order among as many."""
        if best.form.shape == "harmonic":
            return min(1.0, best.evidence.p_value * len(self.forms))
        return self._chance_of_two if best.form.other else self._chance

    @cached_property
    def _chance(self) -> float:
        return self.chance_of(self.forms, self.gains)

    @cached_property
    def _chance_of_two(self) -> float:
        return self.chance_of([*self.forms, *self.products], np.append(self.gains, self.product_gains))

    def chance_of(self, forms: Sequence[Form], gains: np.ndarray) -> float:
        """Chance that the best of some forms gains as much with their signals moved in time."""
        screen = Screen(self.model, self.channel, COARSE)
        shapes = list(dict.fromkeys(replace(form, port="") for form in forms))
        row = {shape: index for index, shape in enumerate(shapes)}
        every = [screen.means.of(_values(self.model.bench, shape, self.signals)[:, None]) for shape in shapes]
        values = np.column_stack(every) * screen.means.per_mean[:, None]
        by_port = []
        for port, column in self.sensitivities.items():
            rows = [row[replace(form, port="")] for form in forms if form.port == port]
            if rows:
                by_port.append((screen.means.of((column * screen.keep)[:, None]), values[:, rows]))
        gain = gains.max()
        for number in range(CHANCES):
            shift = int(len(values) * self.random.uniform(0.1, 0.9))
            if any(float(screen.scores_of(does * np.roll(own, shift, axis=0)).gain.max()) >= gain for does, own in by_port):
                # One maximum that is as good already exceeds the level: no need to go on.
                return 2.0 / (2.0 + number)
        return 1.0 / (1.0 + CHANCES)

    def at_another_time(self, form: Form) -> float:
        """Gain of a term with its signal moved in time, as if the log were a circle, the median of a few; none for a ripple.

        The median, not the largest: a signal that rises once and stays is nearly the same when moved by a little."""
        return 0.0 if form.shape == "harmonic" else float(np.median(self.gains_moved(form)))

    def gains_moved(self, form: Form) -> np.ndarray:
        """The same of a form that is no ripple, for each of the shifts."""
        values = _values(self.model.bench, form, self.signals)
        by = [int(len(values) * self.random.uniform(0.25, 0.75)) for _ in range(SHIFTS)]
        columns = np.column_stack([self.sensitivities[form.port] * np.roll(values, shift) for shift in by])
        return self.screen.scores(columns).gain


def covered_by(signals: np.ndarray) -> dict[str, tuple[float, float]]:
    """Range of each signal that varies."""
    result = {}
    for index, name in enumerate(SIGNALS):
        known = signals[np.isfinite(signals[:, index]), index]
        if len(known) and np.ptp(known) > 1e-9 * max(abs(known.max()), 1e-12):
            result[name] = float(known.min()), float(known.max())
    return result


def _sensitivity(model: Model, channel: str, port: str) -> np.ndarray:
    """What one unit at a port does to a channel, minus the derivative of the residual."""
    constant = Form(port, "motor_speed", "none", "constant", "always", 1.0, 0.0, 1.0, 1.0, -1e9, 1e9)
    return _find_regressors(model, channel, constant)[0]


def _find_regressors(model: Model, channel: str, form: Form) -> list[np.ndarray]:
    """A form's regressors, by the estimator itself."""
    index = free_place(model)
    bench = with_term(model.bench, form.term(), index)
    own = [coordinate_of(index, channel, form, "coefficient", "")]
    if form.shape == "harmonic":
        own.append(coordinate_of(index, channel, form, "sine", ""))
    return bench.regressors(model.values, [Probe(c) for c in own], model.residual, model.heat)


def standing_terms(model: Model) -> dict[int, Term]:
    """Terms that do something, or that a fit moves, by place. One that was taken out again stays in the calibration of a
    search with a coefficient of zero, so that coordinates keep their places."""
    moved = {c.effect for c in model.values}
    return {i: t for i, t in enumerate(model.bench.calibration.terms) if t.coefficient or t.sine or t.name in moved}


def free_place(model: Model) -> int | None:
    """Place in the calibration for one more term; None if there is none."""
    standing = standing_terms(model)
    return next((place for place in range(MOST) if place not in standing), None)


def with_term(bench: Bench, term: Term, place: int) -> Bench:
    """With a term at a free place."""
    terms = bench.calibration.terms
    return bench.under(msgspec.structs.replace(bench.calibration, terms=(*terms[:place], term, *terms[place + 1 :])))


def _is_place(form: Form) -> bool:
    """Whether a form acts at one place along the motor angle."""
    return form.signal == "motor_angle" and form.shape == "bump"


def coordinate_of(index: int, channel: str, form: Form, field: str, effect: str) -> Coordinate:
    key = f"terms[{index}].{field}"
    if field in ("coefficient", "sine"):
        low, high = form.amplitudes
        moves = (Move(key, 1.0, low, high),)
        return Coordinate(
            key, channel, 0.0, form.step, np.inf, moves, low, high, HOOKS[form.port].unit, effect, parameter=field
        )
    low, high, prior = form.bounds(field)
    start = getattr(form, field)
    return Coordinate(
        key, channel, start, 1e-3 * prior, prior, (Move(key, 1.0, low, high),), low, high, effect=effect, parameter=field
    )  # fmt: skip


def _screen_forms(
    screen: Screen, forms: Sequence[Form], sensitivities: Mapping[str, np.ndarray], signals: list[np.ndarray]
) -> Scores:
    """All forms, each as what its port does times what its shape makes of its signal."""
    shapes: dict[Form, list[int]] = {}
    for index, form in enumerate(forms):
        shapes.setdefault(replace(form, port=""), []).append(index)
    bench = screen.model.bench
    u, a = np.zeros((len(forms), bench.episodes)), np.zeros((len(forms), bench.episodes))

    def scored(members: list[int]) -> Scores:
        values = _values(bench, forms[members[0]], signals)
        does = [sensitivities[forms[index].port] for index in members]
        return screen.scores_of(screen.means.of_products(does, values * screen.keep))

    for members, part in zip(shapes.values(), bench.map(scored, shapes.values()), strict=True):
        u[members], a[members] = part.u, part.a
    return Scores(u, a)


def _values(bench: Bench, form: Form, signals: list[np.ndarray]) -> np.ndarray:
    """What a form of coefficient one makes of its signal, at every sample."""
    return _evaluate(bench, record_of(replace(form, port=form.port or PORTS[0])), signals)


def _evaluate(bench: Bench, record: np.void, signals: list[np.ndarray]) -> np.ndarray:
    largest = bench.calibration.stiffness.maximum_force_N
    parts = zip(bench.trials, signals, strict=True)
    return np.concatenate([evaluate(record, own, trial.dt, largest) for trial, own in parts])


def record_of(form: Form) -> np.void:
    """A term (TERM) of coefficient one that nothing limits."""
    record = _unheld(form.term())
    record["coefficient"] = 1.0
    return record


def _unheld(term: Term) -> np.void:
    """A term (TERM) that nothing limits."""
    parameters = np.zeros(1, PARAMETERS)[0]
    fill_terms(parameters, (term,))
    parameters["term"][0]["limit"] = parameters["term"][0]["growth"] = np.inf
    return parameters["term"][0]


def _best_of(forms: Sequence[Form], gains: np.ndarray, most: int) -> list[Form]:
    """The best forms, no more than two of one port, signal and memory: near relatives tell the same. Of a product it matters
    which of its signals is shaped."""
    chosen: list[Form] = []
    for index in np.argsort(-gains):
        form = forms[index]
        relatives = [f for f in chosen if (f.port, f.signals, f.memory) == (form.port, form.signals, form.memory)]
        if gains[index] > 0.0 and len(relatives) < 2:
            chosen.append(form)
        if len(chosen) == most:
            break
    return chosen


def _sharpen(search: Search, forms: Sequence[Form], gains: np.ndarray) -> list[Form]:
    """The best of some forms with their sizes where left-out episodes gain most."""
    best = _best_of(forms, gains, _SHARPENED)
    best += _of_other_means(forms, gains, best, NEARLY)
    found = list(search.model.bench.map(lambda form: _fit_sizes(search, form), best))
    best, gains = [form for form, _ in found], np.array([gain for _, gain in found])
    chosen = _best_of(best, gains, _SHORTLIST)
    return chosen + _of_other_means(best, gains, chosen, AS_GOOD)


def _of_other_means(forms: Sequence[Form], gains: np.ndarray, chosen: Sequence[Form], share: float) -> list[Form]:
    """The best form of each port and signals that are not among the ``chosen`` ones, but gain this share of the best: many
    shapes of one signal must not keep another from being asked. As many as a shortlist has at most."""
    means = {form.means for form in chosen}
    found: list[Form] = []
    for index in np.argsort(-gains):
        form = forms[index]
        if gains[index] < share * gains.max() or len(found) == _SHORTLIST:
            break
        if gains[index] > 0.0 and form.means not in means:
            means.add(form.means)
            found.append(form)
    return found


def _fit_sizes(search: Search, form: Form) -> tuple[Form, float]:
    """A form with its sizes fitted one after the other on the screen, and its gain there."""

    def gain(tried: Form) -> float:
        return float(search.screen.scores(search.answer(tried)[:, None]).gain[0])

    best = gain(form)
    for size in form.fitted:
        low, high, _ = form.bounds(size)
        now = getattr(form, size)
        for tried in np.linspace(low, high, _TRIES + 2)[1:-1] if size == "centre" else np.geomspace(low, high, _TRIES):
            other = replace(form, **{size: float(tried)})
            reached = gain(other)
            if reached > best:
                best, now = reached, float(tried)
        form = replace(form, **{size: now})
    return form, best


def _ripples(search: Search) -> list[Form]:
    """The strongest ripples over the motor angle at each port that may have one."""
    found = []
    for port in rippling(search.ports) if "motor_angle" in search.covered else ():
        effect = Effect(
            name=port, hook=port, term=lambda: 0.0, equation="", source="",
            parameters=(Parameter("o", "1", *_ORDERS, 1.0, "", _ORDERS),),
            harmonic=Harmonic("o", "c", "s", grows_with="port"),
        )  # fmt: skip
        orders, _ = strongest_orders(search.model, effect, search.channel, {"port": search.sensitivities[port]}, _LOBES)
        found += [harmonic(port, _order(search, port, o), search.model.bench.middle, search.covered) for o in orders]
    return found


def _order(search: Search, port: str, order: float) -> float:
    """A ripple's order where it explains most, within half a lobe of one found by its spectrum."""
    screen, (low, high) = search.screen, search.covered["motor_angle"]
    angle = np.concatenate(search.signals)[:, list(SIGNALS).index("motor_angle")] - search.model.bench.middle
    does = search.sensitivities[port] * screen.keep

    def gain(tried: float) -> float:
        both = np.column_stack([does * np.cos(tried * angle), does * np.sin(tried * angle)])
        columns = screen.beside_nuisances(screen.means.of(both))
        u = columns.T @ screen.residual[:, 0]
        return float(u @ np.linalg.pinv(columns.T @ columns, hermitian=True) @ u)

    # Width of a spectrum's lobe over the whole range of angles.
    lobe = 2.0 * np.pi / max(high - low, 1.0)
    tried = (order + lobe * np.linspace(-0.5, 0.5, 2 * _TRIES + 1)).tolist()
    return max((o for o in tried if o > 0.0), key=gain)


def _term_of(prospect: Prospect) -> Term:
    """The term at the size found; `InvalidValue` where a calibration may not hold it."""
    return prospect.form.term("term:tried", *map(float, prospect.evidence.values))


def _stays_in_bounds(prospect: Prospect) -> bool:
    try:
        return prospect.form.is_physical(_term_of(prospect).coefficient)
    except InvalidValue:
        return False


def _length(prospect: Prospect, alone: float, episodes: int) -> float:
    """What the term adds to the description length of what is left, in nats.

    ``alone``: squared error of left-out episodes without the term, less the noise that no term explains."""
    left = max(1.0 - prospect.evidence.gain / max(alone, 1e-300), 1e-3)
    return description_length(left, prospect.form.numbers, episodes)


def description_length(left: Any, numbers: Any, episodes: int) -> Any:
    """Description length of a squared error and the numbers of what left it, or of arrays of these; an episode counts as one
    observation."""
    return 0.5 * episodes * np.log(left) + 0.5 * numbers * np.log(episodes)
