"""Pages of studies and experiments in a browser: pictures have colours, tables have cells."""

from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from playwright.sync_api import Browser

from .whole_pages import WatchedPage, watched_page

ADDRESS = "http://page.test/"
COLOURED = """(image) => {
  const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
  const painter = canvas.getContext("2d");
  painter.drawImage(image, 0, 0);
  const data = painter.getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let n = 0; n < data.length; n += 4) {
    const channels = data.subarray(n, n + 3);
    count += Math.max(...channels) - Math.min(...channels) > 20;
  }
  return count;
}"""
"""The least number of pixels of a picture that are neither white, black nor grey."""


def open_folder(watched: WatchedPage, folder: Path, html: str) -> None:
    """Opens a page whose pictures lie in a folder."""

    def answer(route: Any) -> None:
        file = folder / route.request.url.removeprefix(ADDRESS)
        if route.request.url == ADDRESS:
            route.fulfill(
                body=f"<!DOCTYPE html><meta charset=utf-8><link rel=icon href=data:,>{html}",
                content_type="text/html",
            )
        elif file.is_file():
            route.fulfill(path=file)
        else:
            route.fulfill(status=404)

    watched.page.route(f"{ADDRESS}**", answer)
    watched.page.goto(ADDRESS)


def assert_page_of_study_is_whole(
    browser: Browser, folder: Path, html: str, pictures: int, tables: int
) -> None:
    """Asserts that a page has so many pictures and at least so many tables, all of them with content."""
    with watched_page(browser) as watched:
        open_folder(watched, folder, html)
        watched.assert_whole()
        assert watched.page.locator("table").count() >= tables
        assert watched.page.locator("img").count() == pictures
        for image in watched.page.locator("img").all():
            assert image.evaluate(COLOURED) > 100, image.get_attribute("src")


def assert_markdown_is_whole(
    browser: Browser, page: Path, pictures: int, tables: int = 1
) -> None:
    """Asserts the same of a page in Markdown, as viewers of Markdown show the page."""
    html = MarkdownIt("commonmark").enable("table").render(page.read_text(encoding="utf-8"))
    assert_page_of_study_is_whole(browser, page.parent, html, pictures, tables)
