"""A found term as an effect file, in the form that a person would have written (docs: adding an effect)."""

import json

import numpy as np

from emb_daemon.calibration.terms import Term
from emb_daemon.effects.terms import BEYOND, SIGNALS

#: Expressions of the shapes over u, by name.
_SHAPED = {
    "constant": "1.0",
    "odd_power": "abs(u) ** p.exponent * (1.0 if u >= 0.0 else -1.0)",
    "even_power": "abs(u) ** p.exponent",
    "saturation": "u / (1.0 + abs(u))",
    "decay": "exp(-abs(u))",
    "onset": "max(u, 0.0)",
    "bump": "exp(-u * u)",
}
_GATES = {
    "always": "",
    "load": "signals[_FORCE] / _LARGEST_N",
    "closing": "(1.0 if signals[_SPEED] > 0.0 else 0.0)",
    "opening": "(1.0 if signals[_SPEED] < 0.0 else 0.0)",
    "turning": "(1.0 if signals[_WHEEL] > TURNING_RAD_PER_S else 0.0)",
    "standing": "(1.0 if signals[_WHEEL] <= TURNING_RAD_PER_S else 0.0)",
}
#: Signals that gates look at.
_LOOKED_AT = {"_FORCE": "clamp_force", "_SPEED": "motor_speed", "_WHEEL": "disc_speed"}
_HELD = "min(max(x, _LOW), _HIGH)"
_MEMORIES = {
    "lag": f"""    x = {_HELD}
    if not s.begun:
        s.begun, s.memory = True, x
    s.memory += (1.0 - exp(-dt / p.memory_scale)) * (x - s.memory)
""",
    "slip": f"""    x = {_HELD}
    if not s.begun:
        s.begun, s.before = True, x
    s.memory = min(max(s.memory + (x - s.before) / p.memory_scale, -1.0), 1.0)
    s.before = x
""",
}
_MEMORIES["deficit"] = _MEMORIES["lag"]
_MEMORIES["peak"] = f"{_MEMORIES['lag']}    s.memory = max(s.memory, x)\n"
#: Memory that acts after the shape instead of before it.
_RESPONSE = """    y = {shaped}
    if not s.begun:
        s.begun, s.memory = True, y
    s.memory += (1.0 - exp(-dt / p.memory_scale)) * (y - s.memory)
"""
#: In proportion to what it acts.
_OTHER = """    y = signals[_OTHER]
    if not np.isfinite(y):
        return 0.0
    share = min(max(({size}) / (_FULL - _NONE), 0.0), {most!r})
"""
#: With which the file is a command as well.
_MAIN = """\
if __name__ == "__main__":
    from emb_daemon.effects.own import extend

    extend(EFFECT)
    from emb_daemon.cli.main import main

    sys.exit(main())""".splitlines()
_SIZES = {
    "scale": "over which it changes",
    "centre": "where it is centred",
    "exponent": "of the power",
    "memory_scale": "that its memory spans",
}


def effect_name(term: Term) -> str:
    """Name of the effect that a term becomes."""
    return term.name.removeprefix("term:").replace(":", "_")


def values(term: Term) -> dict[str, float]:
    """Parameters of the effect that is the term, as a calibration states them."""
    names = ["coefficient", *(["sine"] if term.shape == "harmonic" else []), *_sizes(term)]
    return {name: getattr(term, name) for name in names}


def source(term: Term, maximum_force_N: float, equation: str) -> str:
    """The effect file of a term. ``maximum_force_N`` of the calibration: a gate of load counts in it; ``equation``: as an
    engineer writes it."""
    gate, kernel, words = _GATES[term.gate], _kernel(term), term.signal.replace("_", " ").capitalize()
    used, further = "\n".join(kernel), BEYOND * (term.high - term.low)
    functions = [name for name in ("cos", "exp", "sin") if f"{name}(" in used]
    looked_at = {"_SIGNAL": term.signal} | {key: name for key, name in _LOOKED_AT.items() if key in gate}
    looked_at |= {"_OTHER": term.other} if term.other else {}
    lines = [
        f'"""{equation}."""',
        "",
        "import sys",
        *([f"from math import {', '.join(functions)}"] if functions else []),
        "",
        "import numpy as np",
        "",
        "from emb_daemon.effects.base import Effect, Parameter",
        "from emb_daemon.effects.terms import SIGNALS",
        "from emb_daemon.jit import njit",
        *(["from emb_daemon.models.wheel import TURNING_RAD_PER_S"] if "TURNING" in gate else []),
        "",
        *(f'{key} = list(SIGNALS).index("{name}")' for key, name in looked_at.items()),
        f"#: {words} ({SIGNALS[term.signal]}) between which it is shaped: where it was found, and some way on.",
        f"_LOW, _HIGH = {term.low - further!r}, {term.high + further!r}",
    ]
    if term.other:
        own = f"{term.other.replace('_', ' ').capitalize()} ({SIGNALS[term.other]})"
        lines += [
            f"#: {own} at which it is nothing, and acts in full.",
            f"_NONE, _FULL = {term.other_from!r}, {term.other_high!r}",
        ]
    if term.gate == "load":
        lines += ["#: Clamp force at which it acts in full, N.", f"_LARGEST_N = {maximum_force_N!r}"]
    if term.memory != "response" and term.memory_low is not None and term.memory_high is not None:
        further = BEYOND * (term.memory_high - term.memory_low)
        lines += [
            "#: The same of what it remembers.",
            f"_LEAST, _MOST = {term.memory_low - further!r}, {term.memory_high + further!r}",
        ]
    if term.memory != "none":
        lines += ['STATE = np.dtype([("begun", "?"), ("memory", "f8"), ("before", "f8")], align=True)']
    return "\n".join([*lines, "", "", *kernel, "", "", *_declaration(term, equation), "", *_MAIN]) + "\n"


def _kernel(term: Term) -> list[str]:
    """The compiled function that says what the term adds."""
    harmonic = term.shape == "harmonic"
    shaped = "p.coefficient * cos(u) + p.sine * sin(u)" if harmonic else _SHAPED[term.shape]
    shaped = f"share * ({shaped})" if term.other else shaped
    response = _RESPONSE.format(shaped=shaped) if term.memory == "response" else ""
    body = ("s.memory" if response else f"({shaped})") + (f" * {_GATES[term.gate]}" if _GATES[term.gate] else "")
    if not harmonic:
        body = f"p.coefficient * {body}"
    if np.isfinite(term.limit):
        body = f"min(max({body}, -{term.limit!r}), {term.growth!r})"
    z = {"none": _HELD, "response": _HELD, "deficit": "s.memory - x"}.get(term.memory, "s.memory")
    if term.memory != "response" and term.memory_low is not None:
        z = f"min(max({z}, _LEAST), _MOST)"
    arguments = {"none": "p, signals", "slip": "p, s, signals"}.get(term.memory, "p, s, signals, dt")
    return [
        "@njit",
        f"def term({arguments}):",
        f'    """What it adds, {term.unit}."""',
        "    x = signals[_SIGNAL]",
        f"    if p.coefficient == 0.0{' and p.sine == 0.0' if harmonic else ''} or not np.isfinite(x):",
        "        return 0.0",
        *(
            _OTHER.format(size="y - _NONE" if term.other_from else "abs(y)", most=1.0 + BEYOND).splitlines()
            if term.other
            else []
        ),
        *_MEMORIES.get(term.memory, "").splitlines(),
        *([] if term.shape == "constant" else [f"    u = ({z} - p.centre) / p.scale"]),
        *response.splitlines(),
        f"    return {body}",
    ]


def _declaration(term: Term, equation: str) -> list[str]:
    return [
        "EFFECT = Effect(",
        f"    name={_literal(effect_name(term))},",
        f'    hook="{term.port}",',
        "    term=term,",
        "    parameters=(",
        *(f"        {line}" for line in _parameters(term)),
        "    ),",
        f'    equation="{equation}",',
        f"    source={_literal('found by diagnose, ' + (term.provenance or 'no log named'))},",
        *([] if term.memory == "none" else ["    state=STATE,"]),
        f'    signal="{term.signal}",',
        ")",
    ]


def _literal(text: str) -> str:
    """Text of a calibration as a literal of the effect file: whatever it says, it remains text."""
    return json.dumps(text, ensure_ascii=False)


def _sizes(term: Term) -> list[str]:
    """Parameters that shape a term."""
    shape = [] if term.shape == "constant" else ["scale", "centre"]
    power = ["exponent"] if term.shape in ("odd_power", "even_power") else []
    return [*shape, *power, *(["memory_scale"] if term.memory != "none" else [])]


def _parameters(term: Term) -> list[str]:
    """Its parameters as constructor calls: amplitudes, then what shapes it, each searched from where it was found."""
    own = SIGNALS[term.signal]
    over = "1" if term.memory == "slip" else own
    units = {"scale": over, "centre": over, "exponent": "1", "memory_scale": own if term.memory == "slip" else "s"}
    found = values(term)
    result = []
    for name, value in found.items():
        if name in units:
            reach = max(abs(term.low), abs(term.high))
            low, high = (-reach, reach) if name == "centre" else (value / 10.0, 4.0 if name == "exponent" else 10.0 * value)
            result.append(
                f'Parameter("{name}", "{units[name]}", {low!r}, {high!r}, {value!r}, "{_SIZES[name]}", ({value!r},)),'
            )
        else:
            size = 10.0 * max(abs(found["coefficient"]), abs(term.sine))
            words = "how much of it" if term.shape != "harmonic" else f"{'sine' if name == 'sine' else 'cosine'} of it"
            result.append(f'Parameter("{name}", "{term.unit}", {-size!r}, {size!r}, {value!r}, "{words}"),')
    return result
