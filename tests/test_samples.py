"""The sample data, and the loop on them: where the model fails, what it lacks, and the falling error."""

import pytest

import frictrack as ft


@pytest.mark.slow
def test_the_samples_lead_from_a_failing_model_to_a_complete_one():
    runs = ft.samples.runs(rng=1)
    fit = ft.fit("tustin", runs)
    diagnosis = ft.diagnose(fit)
    assert (diagnosis.verdict, diagnosis.missing) == ("missing", ["patch"])
    assert not diagnosis.unexplained
    assert "repeats at the same place in 3 of 4 runs" in diagnosis.repeats.words
    spans = {span["run"]: span["x"] for span in diagnosis.fails_at}
    assert set(spans) == {"slow", "double_mass", "fast"}
    for begin, end in spans.values():
        assert 0.07 < begin < 0.1 < end < 0.13
    better = ft.fit(fit.model + diagnosis.best.effect, runs)
    for name, true in {
        "coulomb.F_c": 0.9,
        "stribeck.F_s": 1.3,
        "stribeck.v_s": 0.4,
        "viscous.F_v": 0.04,
        "patch.F": 0.4,
    }.items():
        found = better.parameters[name]
        assert found.value == pytest.approx(true, abs=4 * found.std)
    assert better.errors["heldout_rms_um"] < 0.35 * fit.errors["heldout_rms_um"]
    assert ft.diagnose(better, quick=True).verdict == "complete"


@pytest.mark.slow
def test_the_noise_of_the_samples_comes_from_rng():
    first, same, other = (ft.samples.runs(rng=seed)[0].displacement.x for seed in (3, 3, 4))
    assert (first == same).all()
    assert (first != other).any()


def test_the_carriage_is_driven_to_and_fro():
    table = ft.samples.carriage()
    assert table["t_s"].diff().dropna().to_numpy() == pytest.approx(0.005)
    assert table["drive_N"].min() < -50 < 50 < table["drive_N"].max()
