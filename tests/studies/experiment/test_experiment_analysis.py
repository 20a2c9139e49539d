"""The statistics of an experiment: a function of its journal, with every number in a table."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import trilat_net as tn
from tests.json_outline import is_documented
from trilat_net.errors import UsageError
from trilat_net.studies.experiment.experiment_run import begin_experiment

from .experiments import REACH, write_protocol


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("analysis")
    return tn.run_experiment(write_protocol(where), where / "out", jobs=1).folder


def test_means_are_those_of_the_table(folder: Path) -> None:
    found = tn.analyse_experiment(folder)
    with (folder / "trials.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    for mean in found.means["completion_s"]:
        own = [
            np.mean(
                [
                    float(r["completion_s"])
                    for r in rows
                    if (r["participant"], r["condition"]) == (who, mean.condition)
                ]
            )
            for who in ("P1", "P2")
        ]
        assert mean.mean == pytest.approx(np.mean(own))
        assert mean.number == 2
    assert [one.condition for one in found.means["completion_s"]] == ["near", "far"]


def test_everything_is_written_and_named(folder: Path, tmp_path: Path) -> None:
    found = tn.analyse_experiment(folder, tmp_path / "there")
    assert all(path.exists() for path in found.paths)
    assert (tmp_path / "there" / "completion_s.png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads((tmp_path / "there" / "analysis.json").read_text(encoding="utf-8"))
    assert is_documented("experiment analyse", {**facts, "mixed_models": {}})
    assert is_documented("experiment power", tn.compute_experiment_power(0.5).to_dict())
    assert facts["digest"] == tn.open_experiment(folder).plan.digest
    with (tmp_path / "there" / "comparisons.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["measure"] for row in rows} == set(found.means)
    first = next(row for row in rows if row["measure"] == "completion_s")
    assert float(first["interval_low"]) < float(first["difference"]) < float(first["interval_high"])


def test_methods_paragraph_has_delays_as_measured(folder: Path) -> None:
    found = tn.analyse_experiment(folder)
    assert found.methods.startswith("The data of 2 participants were analysed; 0 more were excluded.")
    assert "far (delay 200 ms)" in found.methods
    assert tn.open_experiment(folder).plan.digest in found.methods
    assert found.methods in found.summary()


def test_who_is_excluded_is_said_with_the_reason(folder: Path, tmp_path: Path) -> None:
    found = tn.analyse_experiment(folder, tmp_path / "there", exclude={"P2": "stopped in block 2"})
    assert found.methods.startswith(
        "The data of 1 participant were analysed; 1 more was excluded (P2: stopped in block 2)."
    )
    assert {row["participant"] for row in found.rows} == {"P1"}
    with pytest.raises(UsageError, match="there is no participant P9: there are P1, P2"):
        tn.analyse_experiment(folder, tmp_path / "other", exclude={"P9": ""})


def test_users_within_pairs_have_a_mixed_model(tmp_path: Path) -> None:
    pytest.importorskip("statsmodels", reason="is in the extra stats")
    file = write_protocol(tmp_path, '["m1", "m2"]', REACH.replace("6.0", "1.0"))
    file.write_text(
        file.read_text(encoding="utf-8").replace("participants = 2", "participants = 6"), encoding="utf-8"
    )
    found = tn.analyse_experiment(tn.run_experiment(file, tmp_path / "out", jobs=1).folder)
    assert {model.measure for model in found.fit_models()} == {"force_mean_n", "force_peak_n"}
    assert [one.condition for one in next(found.fit_models()).effects] == ["far"]
    assert "6 participants in 3 pairs" in found.methods


def test_nothing_to_analyse_is_said(tmp_path: Path) -> None:
    begun = begin_experiment(write_protocol(tmp_path), tmp_path / "out")
    with pytest.raises(UsageError, match="no trial that counts is done yet"):
        tn.analyse_experiment(begun.folder)


def test_power_by_theory_lies_in_the_interval_of_drawn_experiments() -> None:
    """G*Power 3.1: d_z = 0.8, two-sided, alpha 0.05 asks for 15 participants for a power of 0.8."""
    found = tn.compute_experiment_power(0.8, 16)
    assert found.least[0.8] == 15
    assert found.simulated is not None
    low, high = found.simulated.interval
    assert low <= found.power <= high
    assert "with 16 participants: power 0.8" in found.summary()
