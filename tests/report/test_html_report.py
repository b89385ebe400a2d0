"""report.html is one whole page, and nothing in it is fetched from outside."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from poet_loc.report.error_tables import Block, consistency_table, error_table
from poet_loc.report.figures import write_figures
from poet_loc.report.html_report import report_page, write_report
from poet_loc.report.summary import to_summary

EMPTY = ("img", "meta", "br")


class Page(HTMLParser):
    """Notes what a browser would fetch, the pictures, the text, and checks that elements are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.pictures: list[bytes] = []
        self.text = ""

    def handle_starttag(self, tag, attributes):
        assert tag not in ("script", "link", "iframe", "object", "embed", "video", "audio", "base")
        if tag not in EMPTY:
            self.open.append(tag)
        for name, value in attributes:
            if name in ("src", "href", "srcset", "data", "action", "background", "poster"):
                head, _, data = value.partition(",")
                if head == "data:image/png;base64":
                    self.pictures.append(base64.b64decode(data, validate=True))
                else:
                    self.fetched.append(value)
            if name == "style":
                assert "url(" not in value

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            assert "url(" not in data
            assert "@import" not in data
        else:
            self.text += data


@pytest.fixture(scope="module")
def page(run_record, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    figures = write_figures(run_record, folder / "figures")
    blocks = [Block(to_summary(run_record.evaluation))]
    tables = [error_table(blocks), consistency_table(blocks)]
    write_report(folder / "report.html", "a <run> & more", tables, figures, "asked:\n  x: <1>\nversions: {}\n")
    parsed = Page()
    parsed.feed((folder / "report.html").read_text(encoding="utf-8"))
    return parsed, figures, folder / "report.html"


def test_nothing_is_fetched_and_everything_is_closed(page):
    parsed = page[0]
    assert parsed.fetched == []
    assert parsed.open == []


def test_every_figure_is_in_it(page):
    parsed, figures, _ = page
    assert len(figures) > 3
    assert sorted(parsed.pictures) == sorted(path.read_bytes() for path in figures)
    assert all(picture.startswith(b"\x89PNG") for picture in parsed.pictures)


def test_tables_options_and_title_are_told(page, run_record):
    text = page[0].text
    assert "a <run> & more" in text
    assert "x: <1>" in text
    for name in run_record.evaluation.names:
        assert name in text


def test_without_ground_truth():
    assert "No ground truth" in report_page("run", [], [], "")
    assert "Found beside" not in report_page("run", [], [], "")
    assert "<li>gravity 1 deg &lt; 2</li>" in report_page("run", [], [], "", ["gravity 1 deg < 2"])


def test_no_address_is_named(page):
    without_pictures = re.sub("base64,[A-Za-z0-9+/=]+", "", page[2].read_text(encoding="utf-8"))
    assert "//" not in without_pictures


def test_common_figures_come_first_then_each_estimate_in_order(page):
    captions = re.findall(r"<figcaption>(\w+):", page[2].read_text(encoding="utf-8"))
    assert captions[:4] == ["top_view", "error_distribution", "trajectory_cam", "trajectory_imu"]
    kinds = [caption.partition("_")[0] for caption in captions if caption.endswith("_fuse_eskf_objects")]
    assert kinds == ["errors", "consistency", "landmarks"]
    first_localized = next(k for k, caption in enumerate(captions) if "_localize_" in caption)
    assert max(k for k, caption in enumerate(captions) if "_fuse_" in caption) < first_localized


@pytest.fixture(scope="module")
def layout(page, browser):
    return browser.layout(page[2])


def test_browser_shows_everything_without_scrolling_sideways(layout, page):
    assert layout.overflow == [0, 0, 0]  # the page and its two tables
    sizes = [Image.open(io.BytesIO(picture)).size for picture in page[0].pictures]
    assert [tuple(size) for size in layout.pictures] == sizes
    assert all(width <= 1280 for width in layout.shown)
    assert "a <run> & more" in layout.text
    assert "x: <1>" in layout.text


def test_browser_shows_the_fusion_and_folds_the_rest(layout, page):
    names = re.findall(r'alt="(\w+)"', page[2].read_text(encoding="utf-8"))
    shown = {name for name, width in zip(names, layout.shown, strict=True) if width > 0}
    assert {"top_view", "errors_fuse_eskf_objects"} <= shown
    assert not any("localize" in name for name in shown)


def test_screenshot_has_text_figures_and_margins(page, browser, tmp_path):
    browser.screenshot(page[2], tmp_path / "page.png")
    pixels = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    assert pixels.shape == (2400, 1280, 3)
    assert (pixels[:, :12] == pixels[0, 0]).all()  # nothing touches the window's left and right
    assert (pixels[:, -12:] == pixels[0, 0]).all()
    assert (pixels[:500].sum(axis=2) < 150).mean() > 0.005  # heading and tables are written
    blue = np.abs(pixels - (0x00, 0x72, 0xB2)).sum(axis=2) < 12
    assert blue[500:].sum() > 1000  # lines of the figures are drawn


def test_browser_is_asked_to_fetch_nothing(layout, page, browser, tmp_path):
    assert layout.refused == []
    spoiled = page[2].read_text(encoding="utf-8").replace("<h2>", '<img src="http://example.invalid/x.png"><h2>', 1)
    (tmp_path / "spoiled.html").write_text(spoiled, encoding="utf-8")
    assert browser.layout(tmp_path / "spoiled.html").refused == ["http://example.invalid/x.png"]
