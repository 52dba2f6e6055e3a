"""Which effects of the catalogue do these logs prove?

Stepwise: the base calibration is refitted, then every candidate is tested against what that leaves. A candidate is
accepted if it passes all of

1. a cluster-robust test over episodes, with the path's base parameters and all accepted effects free, corrected for the
   shapes tried; false discovery rate over the whole catalogue at most 1 % (Benjamini and Hochberg),
2. a gain on episodes left out of the fit that matters: a tenth of the residual and two thousandths of the force,
3. values inside the physical bounds,
4. placebos: a disturbed wheel phase, foreign orders, another episode's temperature must do much worse,
5. comparison with what no model at all can say: if a smooth function of a single signal explains much more, the candidate
   is a shadow of something else.

The best one is added and everything is refitted through the production estimator (Gauss-Newton), until none is left. Then
each accepted effect is tested once more in the presence of the others. Stepwise selection alone would be greedy where two
effects only work together (a slow branch without slip gains nothing), so effects that lost are tried again each round.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain, combinations, product

import numpy as np

from emb_daemon.diagnose.channels import FORCE_CHANNELS, UNITS, Bench, Probe
from emb_daemon.diagnose.evidence import NOT_EXCITED, Moments, Verdict, false_discovery, fit, judge
from emb_daemon.diagnose.knobs import Knob, base_knobs, effect_knob
from emb_daemon.diagnose.signals import signals, smooth_basis
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import HOOKS, Effect

#: False discovery rate over the catalogue.
Q_VALUE = 0.01
#: A gain matters from this share of the channel's residual, and from this share of the RMS of the reference.
_RESIDUAL_SHARE = 0.06
_SIGNAL_SHARE = 0.002
#: What matters in a temperature (K), and of a brake torque's RMS: friction tables are not known better.
_FLOOR_K = 1.5
_TORQUE_SHARE = 0.08
#: Share of the best model-free explanation that a candidate must reach, and of its own gain that placebos must not.
_OF_MODEL_FREE = 0.6
_OF_PLACEBO = 0.5
#: Least number of samples that are worth one, when priors are weighed against data.
_INFLATION = 5.0
#: Two candidates are confounded if the loser would have gained this share of the winner's gain in its place.
_CONFOUNDED = 0.8
#: ... and are as good as each other from here.
_EQUAL = 0.97
_GAUSS_NEWTON = 4
#: A candidate whose chance is below this but not sure, and that explains this share of the residual's mean square, is fitted
#: before it is judged.
_DOUBTFUL, _LARGE = 0.05, 0.25
#: Correlation from which two parameters are known only together.
_TRADE = 0.9
#: Draws of a placebo that runs through the estimator, and of one that does not.
_DRAWS, _SHUFFLES = 2, 5


@dataclass
class Finding:
    """What became of one effect of the catalogue."""

    effect: Effect
    channel: str | None
    accepted: bool = False
    in_calibration: bool = False
    share_explained: float = 0.0
    gain: float = 0.0
    q_value: float = 1.0
    p_value: float = 1.0
    reason: str = ""
    placebos: dict[str, float] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)
    sigmas: dict[str, float] = field(default_factory=dict)
    confounded_with: str | None = None
    manoeuvre: str | None = None


@dataclass
class Attribution:
    """Outcome of a diagnosis, still in the estimator's terms.

    Attributes:
        values: knobs as fitted, base and effects, those that are to be applied.
        sigmas: their standard deviations by the jackknife over episodes.
        residual, initial: by channel, after everything accepted and before anything.
        columns: by channel, the knobs whose regressors stand in `regressors`.
        recalibrated: channels whose base parameters were refitted with a gain that matters, with that gain.
    """

    findings: list[Finding]
    values: dict[Knob, float]
    sigmas: dict[Knob, float]
    initial: dict[str, np.ndarray]
    residual: dict[str, np.ndarray]
    knobs: list[Knob]
    regressors: dict[Knob, np.ndarray]
    recalibrated: dict[str, float]
    signals: dict[str, np.ndarray]
    penalties: dict[str, np.ndarray]
    centre: dict[Knob, float]


class Search:
    """One run of the stepwise search; keeps what the report asks for afterwards."""

    def __init__(self, bench: Bench, progress: Callable[[str, float], None]):
        self.bench = bench
        self.progress = progress
        parameters = bench.parameters[0]
        self.calibrated: set[str] = set()
        knobs = []
        for knob in base_knobs(parameters, len(bench.trials)):
            knobs += self._adopted(knob)
        for effect in REGISTRY:
            channel = bench.channel_of(effect.channel)
            initial = parameters["effects"][effect.name]
            if any(initial[p.name] != 0.0 for p in effect.amplitudes):
                self.calibrated.add(effect.name)
                if channel:
                    knobs += [effect_knob(effect, p.name, channel, float(initial[p.name])) for p in effect.parameters]
        self.knobs: list[Knob] = knobs
        self.values: dict[Knob, float] = dict.fromkeys(knobs, 0.0)
        #: Where a knob's prior is centred, if not at the calibration: a shape is touched up about the start it was chosen at.
        self.centre: dict[Knob, float] = {}
        self.accepted: dict[str, list[Knob]] = {}
        self.initial = bench.residuals({})
        self.residual = self.initial
        self.columns: dict[Knob, np.ndarray] = {}
        #: What became of each effect so far, and channels whose base parameters were off, with what refitting them gains.
        self.history: dict[str, Finding] = {}
        self.recalibrated: dict[str, float] = {}
        self.dropped: set[str] = set()
        self.signals = signals(bench, parameters)
        self.middle = float(np.mean(np.concatenate([trial.log.samples["angle"] for trial in bench.trials])))
        braking = self.signals["brake_torque"][self.signals["brake_torque"] > 20.0]
        self.scale = dict.fromkeys(bench.channels, float(np.sqrt(np.mean(self.signals["clamp_force"] ** 2))))
        self.scale["brake_torque"] = float(np.sqrt(np.mean(braking**2))) if len(braking) else 0.0

    def _adopted(self, knob: Knob) -> list[Knob]:
        channel = knob.channel
        if channel in ("stiffness", "torque") and not self.bench.has_reference:
            channel = "innovation"
        if channel not in self.bench.channels:
            return []
        return [Knob(**{**knob.__dict__, "channel": channel})]

    # -- fitting ------------------------------------------------------------------------------------------------------

    def channel_knobs(self, channel: str) -> list[Knob]:
        return [knob for knob in self.knobs if knob.channel == channel]

    def noise(self, channel: str) -> float:
        """Mean square of the residual where there is one."""
        residual = self.residual[channel]
        counted = residual != 0.0
        return float(np.mean(residual[counted] ** 2)) if counted.any() else 0.0

    def inflation(self, channel: str) -> float:
        """How many samples of the residual are worth one: the design effect of its episodes (Kish 1965)."""
        residual, episode = self.residual[channel], self.bench.episode[channel]
        sums = np.bincount(episode, residual, minlength=self.bench.episodes)
        squares = np.bincount(episode, residual**2, minlength=self.bench.episodes)
        return max(_INFLATION, float((sums**2).sum() / max(squares.sum(), 1e-300)))

    def penalty(self, knobs: list[Knob], channel: str) -> np.ndarray:
        prior = np.array([knob.prior for knob in knobs])
        return self.inflation(channel) * max(self.noise(channel), 1e-12) / prior**2

    def moments(self, channel: str, columns: list[np.ndarray], residual: np.ndarray | None = None) -> Moments:
        residual = self.residual[channel] if residual is None else residual
        table = np.vstack([column.T for column in columns]).T if columns else np.zeros((len(residual), 0))
        return Moments.of(table, residual, self.bench.episode[channel], self.bench.episodes)

    def moved(self, knobs: list[Knob]) -> np.ndarray:
        """How far knobs are from where their priors are centred."""
        return np.array([self.values[knob] - self.centre.get(knob, 0.0) for knob in knobs])

    def objective(self, residual: dict[str, np.ndarray], values: dict[Knob, float], channel: str) -> float:
        knobs = self.channel_knobs(channel)
        moved = np.array([values[knob] - self.centre.get(knob, 0.0) for knob in knobs])
        return float(residual[channel] @ residual[channel] + self.penalty(knobs, channel) @ moved**2)

    def refine(self, channels: set[str]) -> None:
        """Gauss-Newton through the estimator over all knobs of some channels."""
        channels = set(channels)
        for iteration in range(_GAUSS_NEWTON):
            # Heat answers to its parameters so nearly in proportion that one derivative serves all iterations.
            again = channels.intersection(FORCE_CHANNELS) if iteration else channels
            probes = [Probe(knob) for knob in self.knobs if knob.channel in again]
            found = self.bench.regressors(self.values, probes, self.residual)
            self.columns.update({probe.knob: column for probe, column in found.items()})
            steps: dict[Knob, float] = {}
            for channel in channels:
                own = self.channel_knobs(channel)
                table = np.array([self.columns[knob] for knob in own]).T
                penalty = self.penalty(own, channel)
                normal = table.T @ table + np.diag(penalty)
                right = table.T @ self.residual[channel] - penalty * self.moved(own)
                size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
                step = np.linalg.solve(normal / np.outer(size, size) + 1e-9 * np.eye(len(own)), right / size) / size
                limit = np.array([_trust(knob, self.values[knob]) for knob in own])
                # Shortened as a whole: knobs that act against each other must move together.
                step /= max(1.0, float(np.max(np.abs(step) / limit)))
                steps.update(zip(own, step, strict=True))
            before = {channel: self.objective(self.residual, self.values, channel) for channel in channels}
            channels -= self._advance(steps, before, channels)
            if not channels:
                break

    def _stepped(self, steps: dict[Knob, float]) -> dict[Knob, float]:
        """Values after a step, inside their bounds.

        The motor angle counts from anywhere, so a small change of a ripple's order turns its phase by much: cosine and sine
        are turned along, about the middle of the angles that occur."""
        values = self.values | {knob: self.values[knob] + step for knob, step in steps.items()}
        named = {knob.name: knob for knob in steps}
        for effect in REGISTRY:
            harmonic = effect.harmonic
            if not harmonic or f"{effect.name}.{harmonic.order}" not in named:
                continue
            order, cosine, sine = (named[f"{effect.name}.{key}"] for key in (harmonic.order, harmonic.cosine, harmonic.sine))
            turn = steps[order] * self.middle
            size = complex(
                values[cosine] + turn * self.values[sine], -(values[sine] - turn * self.values[cosine])
            ) * np.exp(-1j * turn)  # fmt: skip
            values[cosine], values[sine] = float(size.real), float(-size.imag)
        for knob in steps:
            values[knob] = float(np.clip(values[knob], knob.low, knob.high))
        return values

    def _advance(self, steps: dict[Knob, float], before: dict[str, float], channels: set[str]) -> set[str]:
        """Take the steps, shortened where they do not help; returns the channels that have converged."""
        share = dict.fromkeys(channels, 1.0)
        for _ in range(8):
            tried = self._stepped({knob: share[knob.channel] * step for knob, step in steps.items()})
            residual = self.bench.residuals(tried)
            after = {channel: self.objective(residual, tried, channel) for channel in channels}
            # A channel that stands still gets worse only through another one, which is then to be followed.
            worse = {c for c in channels if share[c] > 0.0 and after[c] > before[c] * (1.0 + 1e-9)}
            if not worse:
                self.values, self.residual = tried, residual
                return {c for c in channels if abs(before[c] - after[c]) < 2e-3 * before[c]}
            for channel in worse:
                share[channel] = 0.0 if share[channel] < 0.02 else 0.25 * share[channel]
        return set(channels)

    # -- testing ------------------------------------------------------------------------------------------------------

    def floor(self, channel: str) -> float:
        """Least RMS of an effect that matters, in the channel's unit."""
        if channel == "temperature":
            return _FLOOR_K
        share = _TORQUE_SHARE if channel == "brake_torque" else _SIGNAL_SHARE
        return max(_RESIDUAL_SHARE * np.sqrt(self.noise(channel)), share * self.scale[channel])

    def counted(self, channel: str) -> int:
        """Residuals of a channel that say something."""
        return max(int(np.count_nonzero(self.residual[channel])), 1)

    def rms(self, gain: float, channel: str) -> float:
        return float(np.sqrt(max(gain, 0.0) / self.counted(channel)))

    def variants(self, effect: Effect, channel: str) -> tuple[list[tuple[tuple[Knob, float], ...]], int]:
        """Shapes in which to test an effect, and how many were looked at to choose them."""
        shapes = effect.shapes
        if not shapes:
            return [()], 1
        parameter = shapes[0]
        knob = effect_knob(effect, parameter.name, channel)
        if effect.harmonic:
            order, tried = self._strongest_order(effect, parameter.starts, channel)
            return ([((knob, order),)] if order else []), tried
        return [((knob, start),) for start in parameter.starts], len(parameter.starts)

    def _strongest_order(self, effect: Effect, limits: tuple[float, ...], channel: str) -> tuple[float | None, int]:
        """Order per turn over which the residual varies most, weighted with the force for a ripple of the gear."""
        samples = np.concatenate([trial.log.samples for trial in self.bench.trials])
        angle, travel = samples["angle"], np.abs(samples["speed"]) * samples["dt"]
        whole, grows_with = effect.harmonic.whole, effect.harmonic.grows_with
        if whole:
            orders = np.arange(limits[0], limits[1] + 0.5)
        else:
            span = max(np.ptp(angle), 1.0)
            orders = np.arange(max(limits[0], 4.0 * np.pi / span), limits[1], 0.5 * np.pi / span)
        knobs = self.channel_knobs(channel)
        residual = self.residual[channel]
        weight = self.signals[grows_with] if grows_with else np.ones(len(residual))
        columns = [self.columns[knob] for knob in knobs]
        if columns:
            table = np.column_stack(columns)
            normal = table.T @ table + np.diag(self.penalty(knobs, channel) + 1e-12)
            residual = residual - table @ np.linalg.lstsq(normal, table.T @ residual, rcond=1e-12)[0]
        best, found = 0.0, None
        low = orders[0]
        while low < orders[-1]:
            # One octave at a time: samples that pass more than a sixth of a period smear it, bins are an eighth of one wide.
            high = 2.0 * low
            slow = (travel * high < 1.0) & (residual != 0.0)
            width = 2.0 * np.pi / (8.0 * high)
            bins = ((angle[slow] - angle.min()) / width).astype(np.int64)
            if not len(bins):
                break
            sums, squares = np.bincount(bins, weight[slow] * residual[slow]), np.bincount(bins, weight[slow] ** 2)
            # One stop's long hold at one angle must not outvote the strokes.
            typical = np.median(squares[squares > 0.0]) if squares.any() else 1.0
            cap = np.minimum(1.0, typical / np.maximum(squares, typical))
            padded = 1 << int(np.ceil(np.log2(4 * len(sums))))
            power = np.abs(np.fft.rfft(cap * sums, padded)) ** 2 / max(float((cap**2 * squares).sum()), 1e-300)
            scanned = 2.0 * np.pi * np.arange(len(power)) / (padded * width)
            chosen = orders[(orders >= low) & (orders < high)]
            if whole and len(chosen):
                power, scanned = np.interp(chosen, scanned, power), chosen
            inside = (scanned >= max(low, orders[0])) & (scanned < min(high, orders[-1] + 1e-9))
            if inside.any() and power[inside].max() > best:
                best, found = float(power[inside].max()), float(scanned[inside][np.argmax(power[inside])])
            low = high
        return found, len(orders)

    def round(self, candidates: list[Effect]) -> dict[str, tuple[Finding, tuple]]:
        """Test all candidates against the present residual."""
        plans, probes = [], []
        for effect in candidates:
            channel = self.bench.channel_of(effect.channel)
            finding = Finding(effect, channel)
            shapes, tried = self.variants(effect, channel) if channel else ([], 1)
            knobs = [effect_knob(effect, p.name, channel) for p in effect.amplitudes] if channel else []
            plans.append((finding, knobs, shapes, tried))
            probes += [Probe(knob, shape) for shape in shapes for knob in knobs]
        columns = self.bench.regressors(self.values, probes, self.residual)
        tested = {}
        for finding, knobs, shapes, tried in plans:
            best: tuple[Verdict, tuple, list[np.ndarray], list[Knob]] = (NOT_EXCITED, (), [], knobs)
            parts = _parts(knobs)
            for shape in shapes:
                for part in parts:
                    own = [columns[Probe(knob, shape)] for knob in part]
                    verdict = self.verdict(finding.channel, own)
                    if not best[2] or (verdict.p_value, -verdict.gain) < (best[0].p_value, -best[0].gain):
                        best = (verdict, shape, own, part)
            verdict, shape, own, knobs = best
            finding.p_value = min(1.0, verdict.p_value * tried * len(parts))
            if finding.channel:
                finding.gain = self.rms(verdict.gain, finding.channel)
                initial = float(self.initial[finding.channel] @ self.initial[finding.channel])
                finding.share_explained = max(verdict.gain, 0.0) / initial if initial > 0.0 else 0.0
            for knob, value, sigma in zip(knobs, verdict.values, verdict.sigmas, strict=False):
                finding.values[knob.name.partition(".")[2]] = float(value)
                finding.sigmas[knob.name.partition(".")[2]] = float(sigma)
            tested[finding.effect.name] = (finding, (knobs, shape, own, verdict))
        everything = [tested[effect.name][0] for effect in candidates]
        padded = np.array([f.p_value for f in everything] + [1.0] * (len(REGISTRY) - len(everything)))
        for finding, q_value in zip(everything, false_discovery(padded), strict=False):
            finding.q_value = float(q_value)
        return tested

    def verdict(self, channel: str, own: list[np.ndarray]) -> Verdict:
        knobs = self.channel_knobs(channel)
        moments = self.moments(channel, [self.columns[knob] for knob in knobs] + own)
        penalty = np.concatenate([self.penalty(knobs, channel), np.zeros(len(own))])
        first = len(knobs)
        return judge(moments, list(range(first)), list(range(first, first + len(own))), penalty)

    def why_not(self, finding: Finding, plan: tuple) -> str:
        """Empty if a tested candidate may be accepted."""
        _, _, own, verdict = plan
        effect, channel = finding.effect, finding.channel
        if channel is None:
            return "these logs hold no reference on which it would show"
        if not own or not len(verdict.values):
            return f"not excited by these logs; {effect.manoeuvre}"
        if finding.q_value > Q_VALUE:
            return f"not significant over {verdict.clusters:.0f} effective episodes (q = {finding.q_value:.2g})"
        return self._unfit(finding, plan)

    def _unfit(self, finding: Finding, plan: tuple) -> str:
        """Empty if nothing but chance speaks against a candidate."""
        knobs, _, _, verdict = plan
        effect, channel = finding.effect, finding.channel
        unit = UNITS.get(channel, "")
        if verdict.gain <= 0.0:
            return "no gain on left-out episodes"
        if finding.gain < self.floor(channel):
            return f"explains {finding.gain:.3g} {unit} RMS, too little to matter (limit {self.floor(channel):.3g} {unit})"
        for knob, value, sigma in zip(knobs, verdict.values, verdict.sigmas, strict=True):
            if not knob.low - 2.0 * sigma <= value <= knob.high + 2.0 * sigma:
                return f"{knob.name.partition('.')[2]} = {value:.3g} {knob.unit} is outside what physics allows"
        free, name = self.model_free(channel)
        if verdict.gain < _OF_MODEL_FREE * free:
            return (
                f"explains {finding.gain:.3g} {unit} RMS where a smooth function of {name} explains "
                f"{self.rms(free, channel):.3g} {unit}: a shadow of something else"
            )
        finding.placebos = self.placebos(effect, plan)
        for text, share in finding.placebos.items():
            if share > _OF_PLACEBO:
                return f"its placebo ({text}) explains {100 * share:.0f} % of the same"
        return ""

    def model_free(self, channel: str) -> tuple[float, str]:
        """Largest gain on left-out episodes of a smooth function of one signal, and that signal."""
        if channel not in self._free:
            best = (0.0, "")
            for name, (without, with_) in self.dependence(channel).items():
                # What a base parameter answers for is nobody's shadow: smoothed, the acceleration shows inertia better than
                # the estimator's own difference of noisy speeds can.
                if (channel, name) == ("torque", "motor_acceleration"):
                    continue
                gain = float((without - with_).sum())
                if gain > best[0]:
                    best = (gain, name)
            self._free[channel] = best
        return self._free[channel]

    def dependence(self, channel: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Squared error of each left-out episode, without and with a smooth function of each signal."""
        if channel not in FORCE_CHANNELS:
            return {}
        knobs = self.channel_knobs(channel)
        base = [self.columns[knob] for knob in knobs]
        keep = self.residual[channel] != 0.0
        result = {}
        for name, signal in self.signals.items():
            basis = smooth_basis(name, signal, self.signals["clamp_force"])
            if not basis.shape[1]:
                continue
            basis = basis * keep[:, None]
            moments = self.moments(channel, [*base, basis])
            own = np.einsum("gii->i", moments.products)[len(knobs) : -1]
            penalty = np.concatenate([self.penalty(knobs, channel), 1e-3 * np.maximum(own, 1e-300) + 1e-12])
            both = fit(moments, penalty)
            plain = fit(moments.select(list(range(len(knobs)))), penalty[: len(knobs)])
            result[name] = (plain.left_out, both.left_out)
        return result

    def placebos(self, effect: Effect, plan: tuple) -> dict[str, float]:
        """Share of a candidate's gain that it reaches with what it rests on disturbed, by placebo."""
        knobs, shape, _, verdict = plan
        channel, random = knobs[0].channel, np.random.default_rng(0)
        result = {}
        for placebo in effect.placebos:
            tables = []
            if placebo.order:
                orders = placebo.order(shape[0][1])
                tables = [self._columns(self.bench, knobs, ((shape[0][0], order),)) for order in orders]
            elif placebo.samples:
                benches = [self.bench.disturbed(placebo.samples, random) for _ in range(_DRAWS)]
                tables = [self._columns(bench, knobs, shape) for bench in benches]
            else:
                base = [self.columns[k] for k in self.channel_knobs(channel) if k.name == HOOKS[effect.hook].like]
                if not base:
                    continue
                signal, episode = self.signals[effect.signal], self.bench.sample_episode
                disturbed = [placebo.signal(signal - signal[0], episode, random) for _ in range(_SHUFFLES)]
                tables = [[np.sum(base, axis=0) * follows] for follows in disturbed]
            gains = [self.verdict(channel, own).gain for own in tables]
            result[placebo.text] = max(0.0, *gains) / verdict.gain
        return result

    def _columns(self, bench: Bench, knobs: list[Knob], shape: tuple[tuple[Knob, float], ...]) -> list[np.ndarray]:
        at = self.residual if bench is self.bench else bench.residuals(self.values)
        found = bench.regressors(self.values, [Probe(knob, shape) for knob in knobs], at)
        return list(found.values())

    # -- the search ---------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Recalibrate, accept effects until none is proven any more, and revise; `outcome` has the result."""
        channels = set(self.bench.channels)
        self.progress("recalibrating", 0.1)
        self.refine(channels)
        self.recalibrated = self._recalibration()
        self._free: dict[str, tuple[float, str]] = {}
        #: Dependence of the residual on each signal before any effect was accepted.
        self.first = {channel: self.dependence(channel) for channel in self.bench.channels if channel in FORCE_CHANNELS}
        history = self.history
        effects = [effect for effect in REGISTRY if effect.name not in self.calibrated]
        limit = len(effects)
        for number in range(limit):
            self._free = {}
            left = [effect for effect in effects if effect.name not in self.accepted and effect.name not in self.dropped]
            self.progress(f"testing {len(left)} candidates, round {number + 1}", 0.2 + 0.5 * (1.0 - 0.6**number))
            tested = self.round(left)
            for name, (finding, plan) in tested.items():
                finding.reason = self.why_not(finding, plan)
                earlier = history.get(name)
                if earlier is None or not earlier.confounded_with or not finding.reason:
                    history[name] = finding
            chosen: list[tuple] = []
            for channel in self.bench.channels:
                passed = [t for t in tested.values() if t[0].channel == channel and not t[0].reason]
                if not passed:
                    continue
                chosen.append(self._settle(passed))
            if chosen:
                self._enter(chosen)
            elif not self._tried(tested):
                break
        if self.accepted:
            # The force that heats the pads has changed: everything once more, together.
            self.progress("refitting everything together", 0.75)
            self.refine(channels)
        self._revise()

    def _tried(self, tested: dict[str, tuple]) -> bool:
        """Whether a candidate that would explain much, but is not sure in the linear test, is sure once it has been fitted.

        Far from the solution the rest of a strong effect, whose shape was only guessed, is what makes it unsure. The fitted
        effect must then pass for itself and all others that might have been tried (Bonferroni)."""
        large = [
            t
            for t in tested.values()
            if t[0].channel in FORCE_CHANNELS
            and t[0].p_value < _DOUBTFUL
            and t[0].gain ** 2 > _LARGE * self.noise(t[0].channel)
            and t[0].q_value > Q_VALUE
            and not self._unfit(*t)
        ]
        if not large:
            return False
        finding, plan = max(large, key=lambda t: t[0].gain / np.sqrt(self.noise(t[0].channel)))
        shapes = finding.p_value / max(plan[3].p_value, 1e-300)
        unsure = finding.reason
        self._enter([(finding, plan)])
        if finding.effect.name not in self.accepted:
            return False
        amplitudes = [knob for knob in self.accepted[finding.effect.name] if not is_shape(knob)]
        verdict = self._as_fitted(finding.effect.name, amplitudes)
        chance = min(1.0, verdict.p_value * shapes * len(REGISTRY))
        if chance > Q_VALUE or verdict.gain <= 0.0:
            self.drop(finding.effect.name, unsure)
            return False
        finding.p_value, finding.q_value, finding.gain = (
            verdict.p_value * shapes,
            chance,
            self.rms(verdict.gain, finding.channel),
        )
        finding.reason = ""
        return True

    def _enter(self, winners: list[tuple]) -> None:
        """Accept one effect per channel and refit; one that leaves its channel worse than before goes out again."""
        channels = {winner[0].channel for winner in winners}
        before = {channel: self.noise(channel) for channel in channels}
        for winner in winners:
            self._accept(winner)
        self.refine(channels)
        for finding, _ in winners:
            if self.noise(finding.channel) >= before[finding.channel]:
                self.drop(finding.effect.name, "no fit of it with the calibration's own parameters is better than without it")

    def drop(self, name: str, reason: str) -> None:
        """Take out an accepted effect, or the recalibration of a channel, and refit what remains of its channel."""
        if name in self.recalibrated:
            del self.recalibrated[name]
            return
        channel = self.history[name].channel
        gone = set(self.accepted.pop(name))
        self.history[name].accepted, self.history[name].reason = False, reason
        self.dropped.add(name)
        self.knobs = [knob for knob in self.knobs if knob not in gone]
        for knob in gone:
            del self.values[knob]
        self.residual = self.bench.residuals(self.values)
        self.refine({channel})

    def _accept(self, winner: tuple[Finding, tuple]) -> None:
        finding, (knobs, shape, _, verdict) = winner
        shapes = [knob for knob, _ in shape]
        # An effect enters with all its orders; those that prove nothing go at the end.
        every = [effect_knob(finding.effect, p.name, finding.channel) for p in finding.effect.amplitudes]
        self.values.update(dict.fromkeys(every, 0.0))
        self.accepted[finding.effect.name] = [*every, *shapes]
        # A whole number of teeth is chosen as one.
        chosen = finding.effect.harmonic is not None and finding.effect.harmonic.whole
        self.knobs += every if chosen else [*every, *shapes]
        for knob, value in zip(knobs, verdict.values, strict=True):
            self.values[knob] = float(np.clip(value, knob.low, knob.high))
        for knob, start in shape:
            self.values[knob] = self.centre[knob] = start
        self.residual = self.bench.residuals(self.values)

    def _settle(self, passed: list[tuple]) -> tuple:
        """The candidate to accept out of those that passed in one channel, and why the others of equal gain are not.

        Two that these logs cannot tell apart, because neither says anything beside the other, are confounded: then the one
        that stands first in the catalogue, where simpler causes come first, is taken, and both are reported so."""
        best = max(passed, key=lambda t: t[1][3].gain)
        rivals = []
        for other in passed:
            if other is best or other[1][3].gain < _CONFOUNDED * best[1][3].gain:
                continue
            beside_best = self.verdict_given(best[0].channel, best[1][2], other[1][2])
            if beside_best.p_value < Q_VALUE and beside_best.gain > 0.0:
                continue
            beside_other = self.verdict_given(best[0].channel, other[1][2], best[1][2])
            if beside_other.p_value < Q_VALUE and beside_other.gain > 0.0:
                other[0].reason = f"explained by {best[0].effect.name}, beside which it says nothing"
                self.history[other[0].effect.name] = other[0]
            else:
                rivals.append(other)
        equal = [best] + [rival for rival in rivals if rival[1][3].gain >= _EQUAL * best[1][3].gain]
        winner = min(equal, key=lambda t: REGISTRY.index(t[0].effect))
        for loser in [t for t in [best, *rivals] if t is not winner]:
            for one, other in ((winner, loser), (loser, winner)):
                one[0].confounded_with = other[0].effect.name
                one[0].manoeuvre = other[0].effect.manoeuvre if one is winner else one[0].effect.manoeuvre
            loser[0].reason = (
                f"confounded with {winner[0].effect.name} on these logs, which is simpler or explains more; to separate them: "
                f"{loser[0].effect.manoeuvre}"
            )
            self.history[loser[0].effect.name] = loser[0]
        return winner

    def verdict_given(self, channel: str, given: list[np.ndarray], own: list[np.ndarray]) -> Verdict:
        knobs = self.channel_knobs(channel)
        moments = self.moments(channel, [self.columns[knob] for knob in knobs] + given + own)
        penalty = np.concatenate([self.penalty(knobs, channel), np.zeros(len(given) + len(own))])
        first = len(knobs) + len(given)
        return judge(moments, list(range(first)), list(range(first, first + len(own))), penalty)

    def _as_fitted(self, name: str, group: list[Knob]) -> Verdict:
        """Test some amplitudes of an accepted effect about the fit, everything else in place."""
        channel, knobs = self.history[name].channel, self.accepted[name]
        own = self.channel_knobs(channel)
        # Its own shape would explain away what the amplitude does: it stands as fitted.
        free = [knob for knob in own if knob not in knobs or not is_shape(knob)]
        restored = self.residual[channel] + np.column_stack([self.columns[k] for k in free]) @ self.moved(free)
        moments = self.moments(channel, [self.columns[k] for k in own], restored)
        tested = [own.index(knob) for knob in group]
        rest = [own.index(knob) for knob in free if knob not in group]
        return judge(moments, rest, tested, self.penalty(own, channel))

    def _revise(self) -> None:
        """Test each accepted effect once more with all others in place; drop what, or which order, no longer holds."""
        for name in list(self.accepted):
            finding, knobs = self.history[name], self.accepted[name]
            channel = finding.channel
            amplitudes = [knob for knob in knobs if not is_shape(knob)]
            dropped: list[Knob] = []
            for group in _orders(amplitudes):
                verdict = self._as_fitted(name, group)
                if verdict.p_value > Q_VALUE or verdict.gain <= 0.0:
                    dropped += group
            if not dropped:
                continue
            if len(dropped) == len(amplitudes):
                finding.reason = "no longer holds beside the other effects"
                del self.accepted[name]
                dropped = knobs
            else:
                self.accepted[name] = [knob for knob in knobs if knob not in dropped]
            for knob in dropped:
                del self.values[knob]
                finding.values[knob.name.partition(".")[2]] = 0.0
                finding.sigmas[knob.name.partition(".")[2]] = 0.0
            self.knobs = [k for k in self.knobs if k not in dropped]
            self.residual = self.bench.residuals(self.values)
            self.refine({channel})

    def _recalibration(self) -> dict[str, float]:
        """Channels in which refitting the base parameters gains on left-out episodes what matters."""
        result = {}
        for channel in self.bench.channels:
            knobs = self.channel_knobs(channel)
            if not knobs:
                continue
            table = np.column_stack([self.columns[knob] for knob in knobs])
            moments = self.moments(channel, [table], self.initial[channel])
            gain = float((moments.products[:, -1, -1] - fit(moments, self.penalty(knobs, channel)).left_out).sum())
            # Without a reference nobody knows which path is off: that is for adaptation to settle, not for a diagnosis.
            if channel != "innovation" and self.rms(gain, channel) >= self.floor(channel):
                result[channel] = self.rms(gain, channel)
        return result

    def _share(self, channel: str, knobs: list[Knob]) -> float:
        """Share of the first residual's mean square that comes back when an effect is taken away again."""
        without = self.bench.residuals({knob: value for knob, value in self.values.items() if knob not in knobs})
        first, last, bare = (float(r[channel] @ r[channel]) for r in (self.initial, self.residual, without))
        return float(np.clip((bare - last) / first, 0.0, 1.0)) if first > 0.0 else 0.0

    def outcome(self) -> Attribution:
        """What the search has found, and what it leaves."""
        history = dict(self.history)
        sigmas: dict[Knob, float] = {}
        penalties = {}
        covariances: dict[tuple[Knob, Knob], float] = {}
        for channel in self.bench.channels:
            every = self.channel_knobs(channel)
            penalties[channel] = self.penalty(every, channel)
            # At a fixed order a ripple's cosine and sine are as sure as its amplitude; with the order they only turn.
            for own in (every, [knob for knob in every if not knob.name.endswith("order_per_turn")]):
                fitted = fit(self.moments(channel, [self.columns[k] for k in own]), self.penalty(own, channel))
                sigmas.update(zip(own, np.sqrt(np.diag(fitted.covariance)), strict=True))
                covariances.update(zip(product(own, own), fitted.covariance.ravel(), strict=True))
        touched = {history[name].channel for name in self.accepted}
        values = dict(self.values)
        for knob in self.knobs:
            if knob.channel not in touched and knob.channel not in self.recalibrated:
                values[knob] = 0.0
        for name, knobs in self.accepted.items():
            finding = history[name]
            finding.accepted = True
            finding.share_explained = self._share(finding.channel, knobs)
            finding.reason = (
                f"q = {finding.q_value:.1g} over episodes, gains {finding.gain:.3g} {UNITS[finding.channel]} on left-out ones"
                + "".join(f", {text} {100 * share:.0f} % of it" for text, share in finding.placebos.items())
                + (", from the difference of both paths: no reference was recorded" if finding.channel == "innovation" else "")
            )
            for knob in knobs:
                key = knob.name.partition(".")[2]
                finding.values[key] = self.values[knob]
                finding.sigmas[key] = float(sigmas.get(knob, 0.0))
            finding.reason += _tradeoffs(knobs, sigmas, covariances)
        for effect in REGISTRY:
            if effect.name in self.calibrated:
                channel = self.bench.channel_of(effect.channel)
                finding = Finding(effect, channel, in_calibration=True, reason="already in the calibration")
                initial = self.bench.parameters[0]["effects"][effect.name]
                finding.values = {p.name: float(initial[p.name]) for p in effect.parameters}
                for knob in self.knobs:
                    group, _, key = knob.name.partition(".")
                    if group == effect.name:
                        finding.values[key] += values[knob]
                        finding.sigmas[key] = float(sigmas[knob])
                history[effect.name] = finding
        return Attribution(
            [history[effect.name] for effect in REGISTRY],
            values, sigmas, self.initial, self.residual, self.knobs, self.columns, self.recalibrated, self.signals, penalties,
            self.centre,
        )  # fmt: skip


def _tradeoffs(knobs: list[Knob], sigmas: dict[Knob, float], covariances: dict[tuple[Knob, Knob], float]) -> str:
    """Which parameters of an effect these logs know only together."""
    text = ""
    for one, other in combinations([knob for knob in knobs if "order_" not in knob.name and (knob, knob) in covariances], 2):
        if abs(covariances[one, other]) > _TRADE * sigmas[one] * sigmas[other]:
            names = " and ".join(knob.name.partition(".")[2] for knob in (one, other))
            text += f"; {names} trade off on these logs: what they do together is known better than either"
    return text


def _orders(knobs: list[Knob]) -> list[list[Knob]]:
    """Amplitudes that stand or fall together: cosine and sine of one order, or all."""
    groups: dict[str, list[Knob]] = {}
    for knob in knobs:
        order = knob.name.partition(".order_")[2]
        groups.setdefault(order[:1] if order[:1].isdigit() else "", []).append(knob)
    return list(groups.values())


def _parts(knobs: list[Knob]) -> list[list[Knob]]:
    """The first orders only, the first two, ..., all: few episodes cannot carry a test of many numbers."""
    groups = _orders(knobs)
    return [list(chain.from_iterable(groups[: count + 1])) for count in range(len(groups))] or [[]]


_SHAPES = {f"{effect.name}.{parameter.name}" for effect in REGISTRY for parameter in effect.shapes}


def is_shape(knob: Knob) -> bool:
    """Whether a knob shapes an effect without switching it on."""
    return knob.name in _SHAPES


def _trust(knob: Knob, now: float) -> float:
    """Longest step that Gauss-Newton may take at once."""
    if "order_per_turn" in knob.name:
        return 0.05
    if knob.unit == "1" and np.isfinite(knob.prior):
        return max(0.3, 0.5 * abs(now))
    return 3.0 * knob.prior if np.isfinite(knob.prior) else np.inf


def searched(bench: Bench, progress: Callable[[str, float], None]) -> Search:
    """Find the effects that the logs of ``bench`` prove. ``progress`` is told what is being done, and the share done."""
    search = Search(bench, progress)
    search.run()
    return search
