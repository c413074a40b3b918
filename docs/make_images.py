"""Write docs/images/cluster.png, input and map of the shipped pipeline `mustang2_cluster`: python
docs/make_images.py.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

PICTURE = Path(__file__).with_name("images") / "cluster.png"


def main() -> None:
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
    PICTURE.parent.mkdir(exist_ok=True)
    both.quantize(256).save(PICTURE, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
