# SPDX-License-Identifier: Apache-2.0
"""Writes docs/dependencies.md: every pinned package with licence and weight, as installed in .venv."""

import importlib.metadata as metadata
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES = (
    "requirements/common.txt",
    "requirements/wheels.txt",
    "requirements/panel.txt",
    "requirements/browser.txt",
    "docs/requirements.txt",
)
LONGEST = 60  # characters of a licence; some packages have the whole text there
HEAD = """# Dependencies

Written by `python docs/dependencies.py` from what is installed. The package itself is Apache-2.0, and so is all that it
does without [slycot](https://github.com/python-control/Slycot), which is GPL-2.0: `synthesize` and `commission` import it
for a design from weights (method `hinf`), nothing else does. Who gives away a program together with slycot has to heed
the GPL; a controller file that came out of it is data. The methods that need no weights (`damped_integrator`, `pid`,
`integrator_notch`) need no slycot. Install it by `pip install --no-deps slycot`: it asks for NumPy 2 and runs on 1.26, and
NumPy 2 would break the scipy, pandas and matplotlib of ROS 2 Jazzy.

Recordings of other programs are read by [h5py](https://www.h5py.org/) (HDF5, MATLAB 7.3),
[npTDMS](https://nptdms.readthedocs.io/) (LabVIEW; LGPL-3.0), [fastparquet](https://fastparquet.readthedocs.io/) and
[openpyxl](https://openpyxl.readthedocs.io/) (.xlsx). They are imported where such a file is read and nowhere else: an
installation without them reads all text, `.mat` to version 7 and NumPy's files, and says what to install for the rest.

The SLICOT library itself is BSD-3-Clause since version 5.7, and so is
[ctrlsys](https://pypi.org/project/ctrlsys/), a translation of it to C with a Python face. It is young and its SB10AD has
not been examined here; once it gives the controllers of `params/` and their gammas, it can take slycot's place in
`piezo_control.design.hinf.slicot`.

On a sourced ROS 2 Jazzy, its own packages take the place of the `ros-…` wheels.
"""


def pinned() -> dict[str, str]:
    """Return the pinned packages and their files of requirements."""
    found = {}
    for file in FILES:
        for line in (ROOT / file).read_text().splitlines():
            if match := re.match(r"([A-Za-z0-9._-]+)==", line):
                found.setdefault(match[1], file)
    return found


def licence(package: metadata.Distribution) -> str:
    """Return what a package says of its licence, in a few words."""
    fields = package.metadata
    manifest = Path(sys.prefix, "share", fields["Name"].removeprefix("ros-").replace("-", "_"))
    if (manifest / "package.xml").exists():  # the wheels of ROS 2 say it there
        return str(ElementTree.parse(manifest / "package.xml").findtext("license"))
    named = [c.split(" :: ")[-1] for c in fields.get_all("Classifier", []) if "License ::" in c]
    text = (
        fields.get("License-Expression") or ", ".join(named) or fields.get("License") or "not said"
    )
    line = text.splitlines()[0]
    return line if len(line) <= LONGEST else f"{line[:LONGEST]}…"


def megabytes(package: metadata.Distribution) -> float:
    """Return what the files of a package take."""
    paths = (Path(package.locate_file(file)) for file in package.files or ())
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def page() -> str:
    """Return the whole page, the heaviest packages first."""
    rows, absent = [], []
    for name, file in pinned().items():
        try:
            package = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            absent.append(name)
            continue
        rows.append((megabytes(package), name, package.version, licence(package), file))
    lines = ["| package | version | licence | MB | from |", "| --- | --- | --- | ---: | --- |"]
    for size, name, version, text, file in sorted(rows, reverse=True):
        lines.append(f"| {name} | {version} | {text} | {size:.1f} | {file} |")
    total = f"Together {sum(row[0] for row in rows):.0f} MB."
    if absent:
        total += f" Not installed where this page was written: {', '.join(absent)}."
    return "\n".join([HEAD, *lines, "", total]) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page())
