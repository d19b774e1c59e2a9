"""Hooks of MkDocs: pages that stand elsewhere in the project or are generated, and links that work here as in the sources.

Pages in docs/ link to files beside docs/ as they lie in the project, so that they can be read there too. The site has a page
for most of these files (`project_pages`); other links become plain text.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from configuration import configuration_page
from links import rewrite_links
from pages import api_pages, page_of, project_pages
from room_graph import draw_graphs

ROOT = Path(__file__).parents[2]
PAGES = project_pages(ROOT)
CONFIGURATION = "configuration.md"

log = logging.getLogger("mkdocs.hooks")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are not in docs/."""
    from mkdocs.structure.files import File

    contents = {CONFIGURATION: configuration_page()} | api_pages()
    contents |= {page: page_of(ROOT / source) for source, page in PAGES.items()}
    for page, content in contents.items():
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Let the links of a page lead to pages of the site, and draw its graphs."""
    sources = {site: source for source, site in PAGES.items()}
    site = page.file.src_uri
    text, lost = rewrite_links(markdown, sources.get(site, f"docs/{site}"), site, PAGES)
    for target in lost:
        if not (ROOT / target).exists():
            log.warning("%s links to %s, which is not in the project", site, target)
    return draw_graphs(text)
