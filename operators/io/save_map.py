"""Write maps: FITS images with world coordinates, or partial HEALPix tables."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.io.fits import Header
from pydantic import Field

from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import OutputError, PipelineError
from zonda.core.maps.map_file import MapFile, Provenance
from zonda.core.maps.noise_figures import (
    NoiseFigure,
    maps_of,
    noise_figures,
    noise_sources,
    noise_stated,
)
from zonda.core.maps.planes import Plane
from zonda.core.maps.units import MapOutput
from zonda.core.output import output_folder
from zonda.core.storage.files import MOST_AT_ONCE, product_path
from zonda.core.storage.fits_files import header_of

MEANINGS = {
    "half_difference": "noise from the difference of two halves",
    "source_free": "map of all but the sky",
}
"""Of the planes of a noise map."""


class SaveMap(MapOutput):
    """FITS files of all maps, in the output folder.

    ``map.fits``, ``noiseless_map.fits`` ...: the signal in the primary HDU (K_RJ, or
    `unit`), then HITS,
    WEIGHTS, NOISE and, where it was made, HALF_DIFFERENCE, all with the same world coordinates;
    HEALPix maps are explicit-index (partial) tables that healpy reads. Of polarized maps I, Q, U
    (POLCCONV = COSMO), HITS, WEIGHTS, the covariance COV_II ... COV_UU and CONDITION. CROSSLINKING
    and the table SCAN_HITS where `BinMap` kept them. NOISE is that of independent samples; where a
    map of the noise alone is there (source-free, half-difference), NOISEFAC in its header is what
    it is to be multiplied by for noise that is correlated between pixels, and NOISEOF says what
    that was measured in, else "white noise only"; of a signal without noise, that NOISE is that of
    the complete map. ``noise_map.fits``: the half-difference of the scans and the source-free run's
    map, with the rms in the middle in kelvin (`central_diameter`). Every file carries beam, seed,
    versions, start (DATE-OBS, MJD-OBS), observing time (EXPTIME), the position of each target
    (OBJECT), the resolved YAML and the log of the run.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    requires = frozenset({"map"})
    provides = frozenset({"map_file"})

    central_diameter: Angle | None = Field(None, gt=0, examples=["1 arcmin"])
    """Diameter of the circle about the target in which the noise map's rms is taken; where absent 1
    arcmin, or five beams or pixels where these are wider."""
    overwrite: bool = Field(True)
    """Replace files of an earlier run; if false, they are an error."""

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        maps = maps_of(data.products, split=False)
        if not maps:
            raise PipelineError(
                "there is no map to write",
                place=self.label,
                cure="add a step that makes one, e.g. BinMap",
            )
        planes = maps_of(data.products)
        runs = data.provenance.get("runs")
        files = {
            product_path(folder, name, ".fits"): MapFile.of(
                name,
                self.in_unit(product),
                noise_stated(planes, name, runs),
            )
            for name, product in maps.items()
        }
        figures = noise_figures(maps, self.central_diameter)
        for name, product in maps.items():
            if sources := noise_sources(maps, name):
                alone: dict[str, Plane] = {
                    of: replace(self.in_unit(found).plane(plane), names={of: MEANINGS[of]})
                    for of, (found, plane) in sources.items()
                }
                cards = noise_cards([f for f in figures if f.product == name])
                files[product_path(folder, f"noise_{name}", ".fits")] = MapFile(
                    f"noise_{name}",
                    self.in_unit(product),
                    alone,
                    cards,
                )
        if not self.overwrite:
            for path in files:
                if path.exists():
                    cure = "remove it, choose another output folder or set overwrite: true"
                    raise OutputError("exists already", place=str(path), cure=cure)
        about = Provenance.of(data)
        at_once = (
            1 if any(product.header is None for product in maps.values()) else MOST_AT_ONCE
        )  # a table is copied
        with ThreadPoolExecutor(at_once, "SaveMap") as pool:  # the disk takes most of the time
            written = [pool.submit(file.write, path, about) for path, file in files.items()]
        data.products["map_file"] = [file.result() for file in written]


def noise_cards(figures: list[NoiseFigure]) -> Header:
    """Header cards of a noise map: weighted rms about zero in the central circle; undefined where
    no pixel is there.
    """
    cards: list[tuple[Any, ...]] = []
    for figure in figures:
        keyword = {"half_difference": "RMSHALF", "source_free": "RMSFREE"}[figure.of]
        where = f"central {np.degrees(figure.diameter) * 60:.3g} arcmin"
        rms = figure.rms if np.isfinite(figure.rms) else None
        cards.append((keyword, rms, f"[K] rms, {where}"))
        if np.isfinite(figure.smoothed):
            cards.append((f"{keyword}B", figure.smoothed, "[K] the same smoothed with the beam"))
    return header_of(cards)
