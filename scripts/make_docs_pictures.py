"""Make docs/pictures: the shell commands of the pages are run as they stand, and their results drawn small.

``python scripts/make_docs_pictures.py [PAGE ...]``. The hearts are read from the folder that TORCHDEFORM_DATA names,
Chromium photographs the head of the report; where one is missing, that picture is left as it is.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
WIDTH = 1000

# Which file of a page's results is its picture.
SOURCES = {
    "how-to/brains": "brains/results/overview.png",
    "how-to/lungs": "lungs/results/overview.png",
    "how-to/hearts": "heart/overview.png",
    "how-to/histology": "histology/results/overview.png",
    "how-to/contrasts": "contrasts/results/overview.png",
    "how-to/grids": "results/grid/grid.png",
    "how-to/volume-change": "contrasts/atrophy/grid.png",
    "start": "results/report.html",
}
# The names that the page on hearts gives to the files of the data folder.
HEARTS = {
    f"{phase}{kind}.png": f"SC-HF-I-09_slice12_{phase}{kind}.png" for phase in ("ED", "ES") for kind in ("", "_label")
}


def commands(page: str) -> list[str]:
    """Return the lines of a page's shell blocks that run torchdeform or one of the project's scripts."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    lines = [
        line
        for block in re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        for line in block.splitlines()
    ]
    return [line for line in lines if line.startswith(("register ", "torchdeform ", "python scripts/"))]


def run(page: str, folder: Path) -> Path | None:
    """Run a page's commands in a folder and return its picture, None if it was not made."""
    for name in ("examples", "scripts", "configs"):
        (folder / name).symlink_to(ROOT / name)
    data = Path(os.environ.get("TORCHDEFORM_DATA", ROOT.parent / "shared" / "data")) / "heart_2d"
    for ours, theirs in HEARTS.items():
        if (data / theirs).is_file():
            shutil.copy(data / theirs, folder / ours)
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    python = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    for line in commands(page):
        done = subprocess.run(["bash", "-c", line], cwd=folder, env={**os.environ, "PATH": path, "PYTHONPATH": python})
        print(f"{page}: {done.returncode}: {line}")
    picture = folder / SOURCES[page]
    return picture if picture.is_file() else None


def photograph(report: Path) -> Path | None:
    """Return a picture of the head of a page, None without a browser."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        return None
    picture = report.with_suffix(".png")
    options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1000,1000")
    subprocess.run([browser, *options, f"--screenshot={picture}", report.as_uri()], check=True, capture_output=True)
    return picture


def main(pages: list[str]) -> None:
    """Make the pictures of the pages that are named, of all if none is."""
    PICTURES.mkdir(exist_ok=True)
    for page in pages or SOURCES:
        with tempfile.TemporaryDirectory() as folder:
            found = run(page, Path(folder))
            if found is not None and found.suffix == ".html":
                found = photograph(found)
            if found is None:
                print(f"{page}: no picture")
                continue
            image = Image.open(found).convert("RGB")
            image.thumbnail((WIDTH, WIDTH))
            name = "report" if page == "start" else Path(page).name
            image.save(PICTURES / f"{name}.jpg", quality=80, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
