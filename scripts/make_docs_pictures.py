"""Make the pictures of the site: the commands of a page are run as they stand, and their result is drawn small.

The site's build does it, see ``docs_hooks.py``. ``python scripts/make_docs_pictures.py FOLDER [PAGE ...]`` writes them.
Chromium photographs the head of the report; without a browser the page shows the overview in its place.
"""

import io
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 1000

# Which file of a page's results is its picture.
SOURCES = {
    "start": "results/report.html",
    "how-to/brains": "brains/results/overview.png",
    "how-to/lungs": "lungs/results/overview.png",
    "how-to/hearts": "hearts/results/overview.png",
    "how-to/histology": "histology/results/overview.png",
    "how-to/contrasts": "contrasts/results/overview.png",
    "how-to/grids": "results/grid/grid.png",
    "how-to/volume-change": "contrasts/atrophy/grid.png",
    "how-to/tissue": "breathing/with/overview.png",
}
# What else is shown of a page's results.
MORE = {"start": {"overview": "results/overview.png"}}
# Pairs that a page registers without and with what is known of their tissue.
COMPARED = {"how-to/tissue": ("bones", "breast", "breathing")}


def commands(page: str) -> list[list[str]]:
    """Return the words of the lines of a page that run torchdeform or one of the project's scripts."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    return [words for words in lines if words and words[0] in ("register", "torchdeform", "python")]


def run(words: list[str]) -> int:
    """Run a command of a page in this process."""
    from phantoms import main as phantoms

    from torchdeform.cli.main import main, torchdeform

    programs: dict[str, Callable[[list[str]], int | None]] = {"register": main, "torchdeform": torchdeform}
    if words[:2] == ["python", "scripts/phantoms.py"]:
        return phantoms(words[2:]) or 0
    return programs[words[0]](words[1:]) or 0 if words[0] in programs else 1


def picture(page: str, folder: Path) -> Path:
    """Run a page's commands in a folder until its picture is there, and return that."""
    found, said = folder / SOURCES[page], io.StringIO()
    (folder / "examples").symlink_to(ROOT / "examples")
    with chdir(folder), redirect_stdout(said), redirect_stderr(said):
        for words in commands(page):
            if found.is_file():
                break
            run(words)
    if not found.is_file():
        raise RuntimeError(f"the commands of {page} do not make {SOURCES[page]}:\n{said.getvalue()}")
    return found if found.suffix == ".png" else photograph(found) or found.with_name("overview.png")


def photograph(report: Path) -> Path | None:
    """Return a picture of the head of a page, None without a browser."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        return None
    image = report.with_suffix(".png")
    options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1000,1000")
    subprocess.run([browser, *options, f"--screenshot={image}", report.as_uri()], check=True, capture_output=True)
    return image


def small(path: Path) -> bytes:
    """Return a picture as a JPEG that is no larger than a page."""
    image, file = Image.open(path).convert("RGB"), io.BytesIO()
    image.thumbnail((WIDTH, WIDTH))
    image.save(file, "JPEG", quality=80, optimize=True)
    return file.getvalue()


def pictures(pages: list[str]) -> Iterator[tuple[str, bytes]]:
    """Yield the names of the pictures of some pages, and their JPEGs."""
    from tissue_pictures import compare

    for page in pages:
        with tempfile.TemporaryDirectory() as folder:
            name = "report" if page == "start" else Path(page).name
            yield name, small(picture(page, Path(folder)))
            for other, path in MORE.get(page, {}).items():
                yield other, small(Path(folder) / path)
            for pair in COMPARED.get(page, ()):
                yield pair, small(compare(Path(folder) / pair))


if __name__ == "__main__":
    for name, data in pictures(sys.argv[2:] or list(SOURCES)):
        Path(sys.argv[1], f"{name}.jpg").write_bytes(data)
