# SPDX-License-Identifier: BSD-3-Clause
"""Pages of reports for tests: written, with their elements balanced, and the data in them."""

import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np

from groma.viz.report.page import write_report


class Balance(HTMLParser):
    """Checks that elements are closed in the order in which they were opened."""

    VOID = frozenset({"meta", "image", "input", "br", "link", "line", "rect", "circle", "path"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        if tag in self.VOID:
            return
        # These may be left open in HTML.
        while self.open and self.open[-1] != tag and self.open[-1] in ("option", "p", "rect"):
            self.open.pop()
        assert self.open.pop() == tag


def write_page(tmp_path, *args, **kwargs) -> str:
    write_report(tmp_path / "page.html", *args, **kwargs)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    assert "{{" not in text
    return text


def data_of(text: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def write_pictures(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.full((480, 640), 90, np.uint8))
