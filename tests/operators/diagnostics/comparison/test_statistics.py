"""Figures, fidelity, spectra and profiles of two maps, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from zonda.core.numerics.sphere import ARCSEC
from zonda.operators.diagnostics.comparison.planes import Plane
from zonda.operators.diagnostics.comparison.radial import (
    profiles,
    radial_spectra,
    ring_edges,
    tapered,
)
from zonda.operators.diagnostics.comparison.statistics import compare, values_of

from .test_planes import gaussian, header


def test_a_known_difference():
    """B = 0.8 A + 3: gain and offset are exact, the difference is 3 - 0.2 A, all are in phase."""
    a = np.random.default_rng(1).standard_normal((40, 50))
    a[0, :5] = np.nan
    found = values_of(a, 0.8 * a + 3.0)
    assert found["gain"] == pytest.approx(0.8, abs=1e-12)
    assert found["offset"] == pytest.approx(3.0, abs=1e-12)
    assert found["gain error"] < 1e-12
    assert found["correlation"] == pytest.approx(1.0)
    rest = (3.0 - 0.2 * a)[np.isfinite(a)]
    assert found["mean difference"] == pytest.approx(rest.mean())
    assert found["rms difference"] == pytest.approx(np.sqrt((rest**2).mean()))
    peak = a.ravel()[np.nanargmax(abs(a))]
    assert found["peak reference"] == peak
    assert found["peak ratio"] == pytest.approx(0.8 + 3.0 / peak)


def test_errors_of_the_fit_are_its_scatter():
    """B = 0.7 A + g, g white: the jackknife of 36 parts gives scores of the gain with unit
    variance.

    60 scores, nearly Student's t of 35 degrees of freedom: the rms is known to 1 / sqrt(120) = 9 %,
    tested at 3.5 sigma.
    """
    scores = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        a, g = rng.standard_normal((2, 48, 48))
        found = values_of(a, 0.7 * a + 0.5 * g + 1.0)
        scores.append((found["gain"] - 0.7) / found["gain error"])
        assert found["gain error"] == pytest.approx(
            0.5 / 48, rel=0.45
        )  # 0.5 / (std of A) / sqrt(n); known to 12 % each
    assert abs(np.sqrt(np.mean(np.square(scores))) - 1) < 0.32
    assert abs(np.mean(scores)) < 4 / np.sqrt(60)


def test_chi2_of_known_noise():
    rng = np.random.default_rng(5)
    noise = rng.uniform(0.5, 2.0, (40, 40))
    a = rng.standard_normal((40, 40))
    found = values_of(a, a + noise * rng.standard_normal((40, 40)), (None, noise))
    assert found["chi2 pixels"] == 1600
    assert abs(found["chi2"] - 1600) < 4 * np.sqrt(2 * 1600)
    both = values_of(a, a + noise * rng.standard_normal((40, 40)), (noise, noise))
    assert both["chi2"] == pytest.approx(800, abs=4 * np.sqrt(2 * 1600) / 2)


def test_fidelity_is_its_equation():
    a = gaussian(61, 2.0, 30.0)
    b = a * 0.9
    b[30, 30] += 0.1 * a.max()
    found = compare(Plane("a", a, header(61, 2.0)), Plane("b", b, header(61, 2.0)), threshold=0.5)
    floor = 0.5 * np.sqrt(np.mean((b - a) ** 2))
    np.testing.assert_allclose(
        found.planes["fidelity"], np.abs(a) / np.maximum(np.abs(b - a), floor), rtol=1e-12
    )
    assert found.planes["fidelity"].max() == pytest.approx(max(a.max() / floor, 10.0))
    assert "snr" not in found.planes


def test_equal_maps_have_infinite_fidelity():
    a = gaussian(41, 2.0, 30.0)
    found = compare(Plane("a", a, header(41, 2.0)), Plane("b", a, header(41, 2.0)))
    assert np.isinf(found.planes["fidelity"]).all()
    assert found.values["gain"] == pytest.approx(1.0)


def test_what_is_not_common_is_cut_away():
    a = np.full((40, 40), np.nan)
    a[10:30, 5:20] = np.random.default_rng(3).standard_normal((20, 15))
    found = compare(
        Plane("a", np.ones((40, 40)), header(40, 2.0)),
        Plane("b", a, header(40, 2.0), noise=np.ones((40, 40))),
    )
    assert found.planes["map"].shape == found.planes["snr"].shape == (20, 15)
    assert (found.header["CRPIX1"], found.header["CRPIX2"]) == (20.5 - 5, 20.5 - 10)
    np.testing.assert_array_equal(found.planes["snr"], a[10:30, 5:20])


def test_white_noise_has_a_flat_spectrum_at_its_level():
    """P = n^2 A whatever the window: mean over rings of 30 realizations; modes of a ring are those
    of its error.
    """
    pixel, n = 2 * ARCSEC, 0.7
    inside = np.hypot(*np.indices((48, 48)) - 23.5) < 22
    window, edges = tapered(inside, pixel), ring_edges((48, 48), pixel, 8)
    noise = np.where(inside, n, 0.0)
    drawn = []
    for seed in range(30):
        values = np.where(inside, n * np.random.default_rng(seed).standard_normal((48, 48)), np.nan)
        found = radial_spectra({"map": values}, window, pixel, edges, {"map": noise})
        drawn.append(found.power["map"] / (n**2 * pixel**2))
    np.testing.assert_allclose(found.white["map"], n**2 * pixel**2, rtol=1e-12)
    mean, modes = np.mean(drawn, axis=0), found.modes
    assert (modes > 0).all()
    error = 1 / np.sqrt(30 * modes)
    assert np.abs((mean - 1) / error)[modes > 1].max() < 4
    scatter = np.std(drawn, axis=0) * np.sqrt(modes)
    assert scatter[modes > 4] == pytest.approx(1.0, abs=4.5 / np.sqrt(60))


def test_coherence_of_half_common_noise():
    """b = a + g of equal powers: the coherence is 1 / sqrt(2), in the mean over all rings of many
    modes.
    """
    rng = np.random.default_rng(9)
    a, g = rng.standard_normal((2, 64, 64))
    window = tapered(np.ones((64, 64), bool), ARCSEC)
    found = radial_spectra({"a": a, "b": a + g}, window, ARCSEC, ring_edges((64, 64), ARCSEC, 6))
    weight = found.modes / found.modes.sum()
    # the variance of a coherence r is (1 - r^2)^2 / (2 N)
    assert (found.coherence * weight).sum() == pytest.approx(
        np.sqrt(0.5), abs=4 * 0.5 / np.sqrt(2 * found.modes.sum())
    )


def test_rings_cover_all_scales_and_have_modes():
    edges = ring_edges((64, 48), ARCSEC, 24)
    assert edges[0] * 64 * ARCSEC == pytest.approx(0.75)
    assert edges[-1] * 2 * ARCSEC == pytest.approx(1.0)
    assert (np.diff(edges) * 64 * ARCSEC >= 1 - 1e-9)[:-1].all()
    found = radial_spectra({"m": np.ones((64, 48))}, np.ones((64, 48)), ARCSEC, edges)
    assert (found.modes > 0).all()


def test_profiles_are_means_in_rings():
    pixel = 2 * ARCSEC
    r = np.hypot(*(np.indices((41, 41)) - 20.0)) * pixel
    found = profiles({"r": r}, r, np.full(r.shape, pixel**2), 8 * ARCSEC, 0.0)
    inner = found.radius < 40 * ARCSEC
    assert (
        np.abs(found.mean["r"] - found.radius)[inner].max() < 1.5 * ARCSEC
    )  # the ring's mean radius is beyond its middle
    ring = (r >= 16 * ARCSEC) & (r < 24 * ARCSEC)
    assert found.mean["r"][2] == pytest.approx(r[ring].mean())
    assert found.error["r"][2] == pytest.approx(r[ring].std() / np.sqrt(ring.sum() - 1))
