"""Three additions to mkdocs: pictures, links to files of the project outside docs, and the help texts of the shell.

mkdocs calls `on_files` once and `on_page_markdown` for each page, see ``hooks`` in mkdocs.yml.
"""

import io
import os
import re
import sys
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

_LINK = re.compile(r"(\]\()([^)#\s:]+)(\))")
_HELP = "<!-- help of all verbs -->"
_COPIES = "project"  # folder of the site with copies of linked files


def on_files(files: Files, /, *, config: MkDocsConfig) -> Files:
    """Add the pictures, as the commands of the pages make them now."""
    for name, data in _pictures():
        files.append(File.generated(config, f"pictures/{name}.jpg", content=data))
    return files


@cache
def _pictures() -> tuple[tuple[str, bytes], ...]:
    """Make them once, however often a page is built again."""
    sys.path.insert(0, str(Path(__file__).parent))
    from make_docs_pictures import SOURCES, pictures

    return tuple(pictures(list(SOURCES)))


def on_page_markdown(markdown: str, /, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page with links to copies of files outside docs, and the shell's help where it is asked for."""
    root, docs = Path(config.config_file_path).parent, Path(config.docs_dir)
    folder = PurePosixPath(page.file.src_uri).parent

    def link(found: re.Match[str]) -> str:
        path = Path(os.path.normpath(docs / folder / found[2]))
        if path.is_relative_to(docs) or not path.is_file():
            return found[0]  # mkdocs checks it
        copy = f"{_COPIES}/{path.relative_to(root).as_posix()}"
        if files.get_file_from_path(copy) is None:
            files.append(File.generated(config, copy, abs_src_path=str(path)))
        return f"{found[1]}{os.path.relpath(copy, folder)}{found[3]}"

    markdown = _LINK.sub(link, markdown)
    return markdown.replace(_HELP, help_texts()) if _HELP in markdown else markdown


def help_texts() -> str:
    """Return what ``torchdeform VERB --help`` prints, a section a verb."""
    from torchdeform.cli.main import VERBS

    sections = (f"## {name}\n\n{verb.summary}\n\n```text\n{_help(name)}\n```" for name, verb in VERBS.items())
    return "\n\n".join(sections)


def _help(verb: str) -> str:
    """Return a verb's help as narrow as a page, without colours."""
    from torchdeform.cli.main import torchdeform

    settings: dict[str, Any] = {"COLUMNS": "84", "TERMINAL_WIDTH": "84", "NO_COLOR": "1"}
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    text = io.StringIO()
    try:
        with redirect_stdout(text):
            torchdeform([verb, "--help"])
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    return "\n".join(line.rstrip() for line in text.getvalue().strip("\n").splitlines())
