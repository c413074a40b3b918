"""Write the pictures of docs/images: python docs/make_images.py.

`cluster.png` has input and map of the shipped pipeline `mustang2_cluster`, `wiener.png` what the
first block of docs/linear.md makes.
"""

from __future__ import annotations

import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"


def cluster() -> None:
    """Run the pipeline, put two of its pictures side by side, with few colours: the file stays
    small.
    """
    with TemporaryDirectory() as folder:
        subprocess.run(
            [
                Path(sys.executable).with_name("zonda"),
                "run",
                "mustang2_cluster",
                "--output",
                folder,
            ],
            check=True,
        )
        parts = [
            Image.open(Path(folder) / name).convert("RGB") for name in ("input.png", "map.png")
        ]
    both = Image.new("RGB", (sum(p.width for p in parts), max(p.height for p in parts)), "white")
    left = 0
    for part in parts:
        both.paste(part, (left, 0))
        left += part.width
    write(both, "cluster.png")


def wiener() -> None:
    """Draw the maps of the page, and the sky."""
    from matplotlib.figure import Figure

    page, names = (DOCS / "linear.md").read_text(), dict[str, Any]()
    exec(re.search(r"```python\n(.*?)```", page, re.S)[1], names)  # type: ignore[index]
    figure = Figure((12.6, 3.6), layout="constrained")
    data = names["data"]
    for k, (title, made) in enumerate(
        {
            "maximum likelihood": data["map"],
            "Wiener filter": names["estimate"],
            "sky": data["truth/map"],
        }.items()
    ):
        made.plot(ax=figure.add_subplot(1, 3, k + 1), title=title, limits=(-3e-3, 3e-3))
    with BytesIO() as file:
        figure.savefig(file, dpi=100)
        write(Image.open(file).convert("RGB"), "wiener.png")


def write(picture: Image.Image, name: str) -> None:
    """Save a picture with few colours."""
    IMAGES.mkdir(exist_ok=True)
    picture.quantize(256).save(IMAGES / name, optimize=True)
    print(f"{name}: {(IMAGES / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    cluster()
    wiener()
