"""Drives of simulated brakes for the tests of diagnosis."""

import dataclasses

import numpy as np

from emb_daemon.plant.car import COUNT_RAD
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import random_angle, simulate_log
from studies.drives import rig_drag, rig_stop, training


def drive(plant, rng, stops):
    """What the campaign of a blind trial has, in two thirds of its time: everything here is run over it some hundred times."""
    schedule = training(plant, 21.0) + random_angle(plant, 6.0, rng)
    for force in np.exp(rng.uniform(np.log(2000.0), np.log(22000.0), stops)):
        schedule += rig_stop(force, rng.uniform(20.0, 60.0), 3.0, 6.5)
    return schedule + rig_drag(rng.uniform(2500.0, 5000.0), rng.uniform(20.0, 40.0), 10.0)


def drives(calibration, seed, effects, reference=True, stops=5, drive=drive, wheels_rad=COUNT_RAD):
    """Two drives of one brake, each simulated when it is asked for."""
    plant = plant_from_calibration(calibration, seed=seed, effects=effects)
    rng = np.random.default_rng(seed)
    schedules = [drive(plant, rng, stops) for _ in range(2)]
    for k, schedule in enumerate(schedules, start=1):
        yield simulate_log(plant, schedule, seed=seed + k, reference=reference, wheels_rad=wheels_rad)[0]


def with_late(log, samples, *names):
    """The log with ``names`` of its signals so many ``samples`` old, beside others that are not."""
    rows = log.samples.copy()
    for name in names:
        rows[name] = np.concatenate([np.full(samples, rows[name][0]), rows[name][:-samples]])
    return dataclasses.replace(log, samples=rows)
