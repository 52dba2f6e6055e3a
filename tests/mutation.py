"""Mutation testing: does a test fail when one operator, comparison or constant of a kernel is changed?

Run as ``python tests/mutation.py [COUNT] [SEED] [PART]``. COUNT mutants (60), of modules whose path contains PART (all), are
drawn from E2E check, authentication, reception, the filter, plausibility, monitor, training, discovery, state files and
runtime; each is built into a copy of the package, on which the tests that hold these run as plain Python until the first
fails. Survivors are printed with their line.
"""

import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Module, and the tests that must notice, quick enough as plain Python.
_KEPT = [
    "tests/test_adapt.py::test_where_the_state_is_kept",
    "tests/test_snapshots.py::test_a_record_comes_back_to_the_last_bit",
    "tests/test_snapshots.py::test_a_record_of_another_shape_is_named",
    "tests/test_snapshots.py::test_it_belongs_to_one_corner_actuator_and_calibration",
    "tests/test_snapshots.py::test_whatever_a_file_holds_the_corner_starts",
    "tests/test_snapshots.py::test_what_is_no_file_holds_nobody_up",
    "tests/test_snapshots.py::test_a_file_that_cannot_be_set_aside_stops_nothing",
    "tests/test_snapshots.py::test_a_file_of_another_format_is_set_aside",
    "tests/test_snapshots.py::test_a_state_directory_is_one_daemons",
    "tests/test_snapshots.py::test_what_a_killed_writer_left_goes_after_an_hour_and_not_before",
    "tests/test_adapt.py::test_history_is_bounded_and_a_rejection_changes_nothing_in_use",
    "tests/test_training_rules.py::test_values_of_an_accepted_training_alone_are_kept",
]
_RUNTIME = [
    "tests/test_faults_loop.py",
    "tests/test_daemon.py::TestPacer",
    "tests/test_daemon.py::test_the_service_manager_hears_ready_watchdog_and_stopping",
    "tests/test_reload.py::test_corners_are_not_changed_by_a_reload",
    "tests/test_reload.py::test_a_bad_calibration_is_named_and_the_old_one_stays",
    *(
        f"tests/test_pages.py::{name}"
        for name in (
            "test_a_page_is_used_as_a_file_with_its_numbers_would_be",
            "test_what_no_file_may_hold_is_refused_and_nothing_changes",
            "test_no_page_is_taken_or_left_but_at_rest",
            "test_a_loop_that_reading_kept_from_hearing_gets_a_moment_to_hear",
            "test_pages_are_taken_one_after_the_other",
            "test_what_could_not_be_checked_is_not_taken",
            "test_a_page_that_was_checked_too_late_is_not_taken",
            "test_a_reload_that_waits_comes_first",
            "test_a_reload_goes_back_to_the_file",
            "test_a_page_ends_though_the_file_is_bad_by_then",
        )
    ),
]
_CMAC = ["tests/test_secoc.py::test_vectors_of_rfc_4493", "tests/test_secoc.py::test_every_length_has_the_cmac_of_the_rfc"]
_SECOC = [
    f"tests/test_secoc.py::{name}"
    for name in (
        "test_vectors_of_rfc_4493",
        "test_check_value_of_the_documentation",
        "test_authenticator_and_its_place_are_those_of_cantools",
        "test_what_stands_on_the_wire",
        "test_after_lost_authentications_the_next_is_right",
        "test_a_lost_freshness_frame_costs_nothing",
        "test_who_lost_more_than_a_reset_waits_for_the_next_freshness_frame",
        "test_a_receiver_that_starts_late_is_in_step_with_the_next_freshness_frame",
        "test_what_was_heard_before_a_restart_is_not_believed_after_it",
        "test_a_set_counts_whole_or_not_at_all",
        "test_a_rival_is_refused_with_the_genuine_frame_and_the_next_sample_waits",
        "test_who_is_not_in_step_or_has_no_key_believes_nothing",
        "test_a_flood_of_authentication_frames_costs_a_bounded_number_of_tries",
        "test_frames_of_other_kinds_pass_to_be_refused_for_that",
        "test_more_than_eight_frames_that_wait_are_refused_the_oldest_first",
        "test_the_last_set_comes_no_second_time",
        "TestFreshnessFile",
        "TestConfiguration",
        "TestKeys",
    )
]
#: Those that follow no drive of minutes.
_HYPOTHESES = "not (attributed or closes or drifts_takes or lubricant or fades or proven_where or first_st or noisy)"
_TRAINING = ["tests/test_training_rules.py", "tests/test_adaptation.py"]
_EVIDENCE = [
    f"tests/test_diagnose_evidence.py::{name}"
    for name in (
        "test_evidence_is_what_its_definition_gives",
        "test_two_episodes_alone_prove_nothing_however_much_they_say",
        "test_what_is_nothing_or_no_number_is_not_judged",
        "test_a_column_that_is_nothing_leaves_the_others_alone",
        "test_means_are_of_as_many_samples_as_asked_for",
        "test_left_out_error_is_that_of_fits_without_the_episode",
        "test_one_episode_proves_nothing",
        "test_a_regressor_that_nuisances_span_is_not_credited",
        "test_means_lose_nothing_that_lasts_and_cross_no_episode",
        "test_a_true_effect_is_seen_with_its_size_and_sigma",
        "test_autocorrelated_noise_is_no_effect",
        "test_episodes_end_when_the_brake_is_released_and_long_ones_are_cut",
        "test_a_hold_is_one_episode_however_long",
        "test_a_hold_begins_when_the_motor_has_stopped",
        "test_episodes_are_the_same_whenever_a_log_begins",
        "test_a_short_log_is_cut_into_forty_pieces_and_no_shorter_than_half_a_second",
        "test_a_pause_of_less_than_a_third_of_a_second_ends_no_application",
        "test_holds_whose_way_was_not_recorded_are_several_episodes",
    )
]
SCOPE = {
    "emb_daemon/wire/e2e.py": ["tests/test_wire.py"],
    "emb_daemon/wire/receive.py": [
        "tests/test_wire.py",
        "tests/test_hostile.py::test_a_sender_that_was_held_up_may_catch_up",
        "tests/test_hostile.py::test_spoofed_frames_with_the_next_counter_come_too_early",
        "tests/test_hostile.py::test_a_sender_whose_clock_runs_slower_is_followed",
    ],
    "emb_daemon/wire/cmac.py": _CMAC,
    "emb_daemon/wire/secoc.py": _SECOC,
    "emb_daemon/wire/keys.py": _SECOC,
    "emb_daemon/runtime/secured.py": _SECOC,
    "emb_daemon/models/plausibility.py": ["tests/test_plausibility_kernels.py"],
    "emb_daemon/models/fusion.py": ["tests/test_kernels.py"],
    "emb_daemon/estimator/monitor.py": ["tests/test_monitor_bounds.py"],
    "emb_daemon/estimator/hypotheses.py": ["tests/test_hypotheses.py", "-k", _HYPOTHESES],
    "emb_daemon/estimator/status.py": ["tests/test_status.py"],
    "emb_daemon/estimator/step.py": [
        "tests/test_status.py",
        "tests/test_step.py",
        "tests/test_lateness.py::test_what_the_calibration_knows_or_holds_for_exact_is_not_undone",
    ],
    "emb_daemon/adapt/training.py": _TRAINING,
    "emb_daemon/adapt/adaptation.py": _TRAINING,
    "emb_daemon/diagnose/episodes.py": _EVIDENCE,
    "emb_daemon/diagnose/evidence.py": _EVIDENCE,
    "emb_daemon/bounded.py": _KEPT,
    "emb_daemon/adapt/files.py": _KEPT,
    "emb_daemon/adapt/memory.py": _KEPT,
    "emb_daemon/adapt/snapshots.py": _KEPT,
    "emb_daemon/runtime/daemon.py": _RUNTIME,
    "emb_daemon/runtime/changes.py": _RUNTIME,
    "emb_daemon/runtime/rawcan.py": _RUNTIME,
}
_SWAPPED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.BitXor: ast.BitOr, ast.BitAnd: ast.BitOr, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


def _sites(tree: ast.Module) -> list[tuple[ast.AST, int]]:
    """Nodes inside functions that can be changed, with the index of the comparison. Decorators are left out: their signatures
    matter only where kernels are compiled ahead."""
    sites = []
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for node in (part for statement in function.body for part in ast.walk(statement)):
            if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in _SWAPPED:
                sites.append((node, -1))
            elif isinstance(node, ast.Compare):
                sites += [(node, index) for index, op in enumerate(node.ops) if type(op) in _SWAPPED]
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                sites.append((node, -1))
    return sites


def _change(node: ast.AST, index: int) -> None:
    if isinstance(node, ast.Compare):
        node.ops[index] = _SWAPPED[type(node.ops[index])]()
    elif isinstance(node, ast.Constant):
        node.value += 1
    else:
        node.op = _SWAPPED[type(node.op)]()


def _noticed(copy: Path, tests: Sequence[str]) -> bool:
    # Compiling a mutant takes longer than interpreting its tests.
    environment = os.environ | {"PYTHONPATH": str(copy), "NUMBA_DISABLE_JIT": "1"}
    environment.setdefault("EMB_SHARED", str(ROOT.parent / "shared"))
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=300
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def main() -> None:
    words = (*sys.argv[1:], *("60", "0", "")[len(sys.argv) - 1 :])
    count, seed, part = int(words[0]), int(words[1]), words[2]
    mutants = [
        (module, place)
        for module in SCOPE
        if part in module
        for place in range(len(_sites(ast.parse((ROOT / module).read_text()))))
    ]
    drawn = sorted(random.Random(seed).sample(mutants, min(count, len(mutants))))
    killed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "package"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "__pycache__"))
        for tests in {tuple(SCOPE[module]) for module, _ in drawn}:
            assert not _noticed(copy, tests), f"{' '.join(tests)} fail without a mutant"
        for module, place in drawn:
            source = (ROOT / module).read_text()
            tree = ast.parse(source)
            node, index = _sites(tree)[place]
            _change(node, index)
            (copy / module).write_text(ast.unparse(tree))
            if _noticed(copy, SCOPE[module]):
                killed += 1
            else:
                line = source.splitlines()[node.lineno - 1].strip()
                print(f"survived: {module}:{node.lineno}: {line}: {ast.unparse(node)}", flush=True)
            (copy / module).write_text(source)
    print(f"{killed} of {len(drawn)} mutants killed, drawn from {len(mutants)}")


if __name__ == "__main__":
    main()
