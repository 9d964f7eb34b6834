"""A hook of MkDocs: figures of benchmarks/ and notebooks are on the site where pages link to them,
as on a forge, and links to what the site has not are plain words."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parent.parent
FOLDERS = {"benchmarks/figures": ("figures", "*.png"), "notebooks": ("notebooks", "*.ipynb")}
ELSEWHERE = re.compile(r"(?<!!)\[([^\]]+)\]\(\.\./[^)]*\)")


def on_files(files, config):
    for folder, (name, pattern) in FOLDERS.items():
        for path in sorted((ROOT / folder).glob(pattern)):
            files.append(File.generated(config, f"{name}/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, **_):
    for folder, (name, _) in FOLDERS.items():
        markdown = markdown.replace(f"](../{folder}/", f"]({name}/")
    return ELSEWHERE.sub(r"\1", markdown)
