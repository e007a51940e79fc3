"""Render docs/*.md to a folder of plain HTML pages; a link to a page or picture that does not exist
is an error."""

from __future__ import annotations

import html
import re
import shutil
import sys
from pathlib import Path

STYLE = (
    "body{max-width:860px;margin:40px auto;padding:0 20px;font:16px/1.6 system-ui,sans-serif}"
    "pre{background:#8882;padding:12px;overflow:auto;border-radius:6px}table{border-collapse:collapse}"
    "td,th{border-bottom:1px solid #8886;padding:4px 12px;text-align:left}img{max-width:100%}"
    ":root{color-scheme:light dark}"
)


def main(target: Path) -> None:
    """Write every page of docs/, or exit with 1 naming the broken links."""
    try:
        import markdown
    except ModuleNotFoundError:
        sys.exit("error: the package 'markdown' is missing; install the extra 'dev'")
    source = Path("docs")
    broken = []
    target.mkdir(parents=True, exist_ok=True)
    for page in sorted(source.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
            if not (page.parent / link).exists():
                broken.append(f"{page}: {link}")
        body = markdown.markdown(text, extensions=["tables", "fenced_code", "toc"])
        body = re.sub(r'href="([\w-]+)\.md', r'href="\1.html', body)
        title = html.escape(text.splitlines()[0].lstrip("# "))
        (target / f"{page.stem}.html").write_text(
            f'<!doctype html><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>{body}',
            encoding="utf-8",
        )
    if (source / "images").is_dir():
        shutil.copytree(source / "images", target / "images", dirs_exist_ok=True)
    if broken:
        sys.exit("broken links:\n" + "\n".join(broken))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
