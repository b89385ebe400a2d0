"""report.html is one whole page, and nothing in it is fetched from outside."""

from __future__ import annotations

import base64
from html.parser import HTMLParser

import pytest

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
    return parsed, figures


def test_nothing_is_fetched_and_everything_is_closed(page):
    parsed, _ = page
    assert parsed.fetched == []
    assert parsed.open == []


def test_every_figure_is_in_it(page):
    parsed, figures = page
    assert len(figures) > 3
    assert parsed.pictures == [path.read_bytes() for path in figures]
    assert all(picture.startswith(b"\x89PNG") for picture in parsed.pictures)


def test_tables_options_and_title_are_told(page, run_record):
    text = page[0].text
    assert "a <run> & more" in text
    assert "x: <1>" in text
    for name in run_record.evaluation.names:
        assert name in text


def test_without_ground_truth():
    assert "No ground truth" in report_page("run", [], [], "")
