"""A hook of MkDocs: figures of benchmarks/ are shown where pages, as on a forge, link to them, and
links to what the site has not are plain words."""

import re
from pathlib import Path

from mkdocs.structure.files import File

FIGURES = Path(__file__).parent.parent / "benchmarks" / "figures"
ELSEWHERE = re.compile(r"(?<!!)\[([^\]]+)\]\(\.\./[^)]*\)")


def on_files(files, config):
    for path in sorted(FIGURES.glob("*.png")):
        files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, **_):
    return ELSEWHERE.sub(r"\1", markdown.replace("](../benchmarks/figures/", "](figures/"))
