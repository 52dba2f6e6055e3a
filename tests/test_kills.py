"""A daemon that learns and is killed loses nothing of it; `python -m studies.kills 500 1` is the long form."""

import os

import adaptkit

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory, Store
from studies import kills as study


def _store(number: int) -> Store:
    empty = Store(format=2, corner="FL", actuator="specimen", calibration=str(number), current=None, history=())
    return adaptkit.accepted(empty)


def test_the_study_of_kills_accepts_no_older_state(tmp_path):
    """Between what a life says before a write and after it, the old file or the new one; after it the new one alone."""
    hears, says = os.pipe()
    memory, stores = study.TellingMemory(tmp_path, says), [_store(number) for number in range(3)]
    for store in stores:
        memory.save(store)
    said = os.read(hears, 1000)
    old, first, second, third = study.digest(None), *map(study.digest, stores)
    assert len({old, first, second, third}) == 4
    assert study.possible(old, b"") == ([old], 0)
    step = len(said) // 6
    assert study.possible(old, said[:step]) == ([old, first], 0)
    assert study.possible(old, said[: 2 * step]) == ([first], 1)
    assert study.possible(old, said[: 5 * step]) == ([second, third], 2)
    assert study.possible(old, said) == ([third], 3)
    for end in (hears, says):
        os.close(end)


def test_the_state_at_an_accepted_training_survives_a_kill(tmp_path, monkeypatch):
    """Not ten seconds later: the snapshots before it belong to values that are no longer in use."""
    monkeypatch.setattr(Adaptation, "close", lambda *_: None)
    study.live(Memory(tmp_path), adaptkit.shipped(), 7.0)
    after = Adaptation({"FL": adaptkit.shipped()}, Memory(tmp_path), int)
    assert after.current("FL") is not None and list(after._resumable) == [0]


def test_a_kill_during_training_keeps_accepted_values(tmp_path):
    result = study.kills(2, 1, tmp_path, adaptkit.shipped(), load=0)
    assert result["kills"] == 2
    assert not any(result[name] for name in ("torn", "lost", "foreign", "snapshots"))
    assert Memory(tmp_path).read("FL") is None or result["kept"] + result["interrupted"]
