"""Young's modulus by the bend under the load and by the swing, and what their contradictions say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rafl.capture.dataset.contradictions import contradictions
from rafl.capture.dataset.modulus import ModulusEstimates, estimate_modulus
from rafl.capture.rendering.motion import SimulatedMotion, tip_load_release, twist_release
from rafl.capture.specimen.specimen import Specimen, read_specimen
from rafl.data.dataset import Dataset, Trajectory

TRUE_MODULUS = 400e3  # [Pa]; the specimen assumes 150 kPa
FPS = 250.0


def recorded(specimen: Specimen, motion: SimulatedMotion) -> Trajectory:
    """A recording with noise of 10 micrometres, of which some markers are missing."""
    markers = specimen.markers(1e-6).positions(torch.from_numpy(motion.q)).numpy()
    markers = markers + np.random.default_rng(0).normal(0.0, 1e-5, markers.shape)
    markers[:, 3] = np.nan
    markers[10:20, 5] = np.nan
    zero = np.zeros_like(motion.q[0])
    valid = np.isfinite(markers[..., 0])
    sigma = np.full_like(markers, 1e-5)
    return Trajectory(
        motion.time, markers, valid, sigma, motion.q[0], zero, zero, zero, zero[:, 0], "train", {"load_g": 60.0}
    )


@pytest.fixture(scope="module")
def released(small_specimen: Specimen) -> Trajectory:
    material = replace(small_specimen.material, youngs_modulus=TRUE_MODULUS)
    return recorded(small_specimen, tip_load_release(small_specimen, material, 0.06, 60, FPS))


def estimated(specimen: Specimen, item: Trajectory, load: float) -> ModulusEstimates:
    return estimate_modulus(specimen.simulator(1.0 / FPS), specimen.markers(1e-6), item, specimen.loaded, load)


def test_both_measurements_find_the_modulus_whatever_is_assumed(small_specimen: Specimen, released: Trajectory) -> None:
    found = estimated(small_specimen, released, 0.06)
    assert found.bend == pytest.approx(TRUE_MODULUS, rel=0.03)
    assert found.swing == pytest.approx(TRUE_MODULUS, rel=0.1)  # implicit Euler slows the recorded swing
    assert np.isnan(estimated(small_specimen, released, 0.0).bend)
    wrong = estimated(small_specimen, released, 6e-5)
    assert wrong.bend == pytest.approx(1e-3 * found.bend)
    assert wrong.swing == found.swing


def test_the_swing_is_compared_with_the_mode_that_moves_the_markers(small_specimen: Specimen) -> None:
    """A twist excites torsion, whose frequency is several times that of bending."""
    material = replace(small_specimen.material, youngs_modulus=TRUE_MODULUS)
    item = recorded(small_specimen, twist_release(small_specimen, material, 1.0, 80, 2000.0))
    found = estimate_modulus(
        small_specimen.simulator(1.0 / 2000.0), small_specimen.markers(1e-6), item, small_specimen.loaded, 0.0
    )
    assert found.swing == pytest.approx(TRUE_MODULUS, rel=0.15)  # it swings under gravity as well


def test_one_cell_has_a_swing(specimen_file: Path) -> None:
    """Its few nodes cannot tell all functions apart from which the search for the modes starts."""
    specimen_file.write_text(specimen_file.read_text().replace("element_mm: 10", "cells: [1, 1, 1]"))
    specimen = read_specimen(specimen_file)
    material = replace(specimen.material, youngs_modulus=TRUE_MODULUS)
    found = estimated(specimen, recorded(specimen, tip_load_release(specimen, material, 0.06, 60, FPS)), 0.06)
    assert found.swing == pytest.approx(TRUE_MODULUS, rel=0.15)  # implicit Euler slows the recorded swing


def test_a_recording_without_an_oscillation_has_no_swing(small_specimen: Specimen, released: Trajectory) -> None:
    still = replace(released, markers=np.repeat(released.markers[:1], len(released.time), axis=0))
    found = estimated(small_specimen, still, 0.06)
    assert np.isnan([found.swing, found.frequency, found.bend]).all()


def test_a_hanging_load_that_no_specimen_holds_is_named(small_specimen: Specimen, released: Trajectory) -> None:
    """60 kg instead of 60 g."""
    mass = np.zeros(len(released.q))
    mass[small_specimen.loaded] = 60.0 / len(small_specimen.loaded)
    load = mass[:, None] * np.array([0.0, 0.0, -9.8])
    item = replace(released, load=load, added_mass=mass)
    swing = estimated(small_specimen, item, 0.0).swing
    assert swing > 1e3 * TRUE_MODULUS
    (line,) = messages(small_specimen, item, (float("nan"), swing), load_g=60000.0)
    assert "with 60000 g hanging on it; correct load_g" in line


def messages(specimen: Specimen, item: Trajectory, *moduli: tuple[float, float], load_g: float = 60.0) -> list[str]:
    """Contradictions of a dataset of recordings with moduli by bend and by swing [Pa]."""
    values = [{"bend_modulus": b, "swing_modulus": s, "swing_hz": 9.0, "load_g": load_g} for b, s in moduli]
    items = {f"r{k}": replace(item, attributes=attributes) for k, attributes in enumerate(values)}
    return contradictions(Dataset("small", specimen.simulator(1.0 / FPS), specimen.markers(1e-6), items))


def test_moduli_that_agree_with_the_assumed_one_say_nothing(small_specimen: Specimen, released: Trajectory) -> None:
    nan = float("nan")
    assert messages(small_specimen, released, (160e3, 200e3), (nan, 110e3), (nan, nan)) == []
    assert messages(small_specimen, released, (nan, 70e3), (60e3, nan)) == []


def test_one_recording_that_differs_from_the_others_is_named(small_specimen: Specimen, released: Trajectory) -> None:
    """Only where the elements do not lock: otherwise bending and torsion give different moduli."""
    nan = float("nan")
    moduli = (nan, 290e3), (nan, 88e3), (nan, 270e3), (nan, 250e3)
    enhanced = replace(small_specimen, material=replace(small_specimen.material, integration="enhanced"))
    assert messages(small_specimen, released, *moduli, (410e3, 390e3)) == []
    assert "agree on a Young's modulus of about 400 kPa" in messages(enhanced, released, (410e3, 390e3))[0]
    (line,) = messages(enhanced, released, *moduli)
    assert line.startswith("recording r1: expected a Young's modulus of about 260 kPa as in the other recordings")


def test_rubber_is_never_softer_in_a_swing_than_in_a_bend(small_specimen: Specimen, released: Trajectory) -> None:
    """Only where the elements do not lock: otherwise both are the mesh's."""
    enhanced = replace(small_specimen, material=replace(small_specimen.material, integration="enhanced"))
    assert messages(enhanced, released, (150e3, 190e3)) == []
    assert messages(small_specimen, released, (150e3, 120e3)) == []
    (line,) = messages(enhanced, released, (150e3, 120e3))
    assert line.endswith("or the size of the body is not that in the specimen's description")


@pytest.mark.parametrize(
    ("moduli", "load_g", "parts", "never"),
    [
        ((150.0, 160e3), 0.06, ("r0: expected one", "64 g, not 0.06 g, typed in kg?"), "frames/s"),
        ((150e3 / 102, 160e3), 0.588, ("64 g, not 0.588 g, typed in N?",), "frames/s"),
        ((150e3, 13.5e3), 60.0, ("at 9 Hz", "about 830 frames/s, not 250 (--fps)"), "load_g"),
        ((600e3, 1500e3), 60.0, ("150 g, not 60 g (load_g", "frames/s", "the density is 430 kg/m3"), "typed"),
        ((610e3, 590e3), 60.0, ("agree on a Young's modulus of about 600 kPa", "has 150 kPa"), "load_g"),
        ((float("nan"), 13.5e3), 0.0, ("found 13.5 kPa by the swing at 9 Hz", "frames/s"), "load_g"),
        ((15e6, float("nan")), 6000.0, ("found 15000 kPa by the bend", "60 g, not 6000 g"), "frames/s"),
    ],
)
def test_contradictions_name_their_likely_cause(
    small_specimen: Specimen,
    released: Trajectory,
    moduli: tuple[float, float],
    load_g: float,
    parts: tuple[str, ...],
    never: str,
) -> None:
    (line,) = messages(small_specimen, released, moduli, load_g=load_g)
    for part in parts:
        assert part in line
    assert never not in line


def test_recordings_that_contradict_alike_share_a_line(small_specimen: Specimen, released: Trajectory) -> None:
    lines = messages(small_specimen, released, (150.0, 160e3), (160.0, 150e3), (610e3, 590e3))
    assert [line.split(":")[0] for line in lines] == ["recordings r0, r1", "recording r2"]
