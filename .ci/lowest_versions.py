"""Constraints for pip: the lowest version of every dependency in pyproject.toml. python
lowest_versions.py [EXTRA ...]
"""

import re
import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
wanted = list(project["dependencies"])
extras = sys.argv[1:]
while extras:
    for text in project["optional-dependencies"][extras.pop()]:
        if own := re.fullmatch(r"zonda\[([\w,]+)\]", text):
            extras += own[1].split(",")
        else:
            wanted.append(text)
for text in wanted:
    found = re.match(r"([\w.-]+)>=([\w.]+)", text)
    if found is None:
        sys.exit(f"pyproject.toml: {text!r} has no lower version")
    print(f"{found[1]}=={found[2]}")
