"""Compare a wheel's content with the tree: every tracked source and data file is there, and nothing
else.
"""

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = {
    "core": "zonda/core",
    "operators": "zonda/operators",
    "plugins": "zonda/plugins",
    "interop": "zonda/interop",
    "pipelines": "zonda/pipelines",
    "zonda": "zonda",
}


def wanted() -> set[str]:
    """Files that belong in a wheel, by their path there."""
    tracked = subprocess.check_output(["git", "ls-files", *FOLDERS], cwd=ROOT, text=True).split()
    files = set()
    for name in tracked:
        top, _, rest = name.partition("/")
        if rest and not (ROOT / name).is_symlink():
            files.add(f"{FOLDERS[top]}/{rest}")
    return files


def main() -> int:
    """Print what is missing or extra; 1 if anything is."""
    packed = {n for n in zipfile.ZipFile(sys.argv[1]).namelist() if ".dist-info/" not in n}
    missing, extra = sorted(wanted() - packed), sorted(packed - wanted())
    for name in missing:
        print(f"missing from the wheel: {name}")
    for name in extra:
        print(f"in the wheel but not in the tree: {name}")
    print(f"{len(packed)} files in the wheel")
    return 1 if missing or extra else 0


if __name__ == "__main__":
    sys.exit(main())
