"""Accessibility of every page in a real browser, dark and light, by the rules of axe-core."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from conftest import Shop
    from playwright.sync_api import Page

expect = pytest.importorskip("playwright.sync_api").expect

AXE = Path(__file__).parents[3] / "scripts/javascript/node_modules/axe-core/axe.min.js"
# The pages with something that is there once they are complete.
PAGES = {
    "": "[data-testid=new-project]",
    "/annotate/1": "[data-testid=fields] input",
    "/train": "main h1",
    "/export": "[data-testid=export-form]",
    "/statistics": "[data-testid=stats-tiles]",
    "/checks": "[data-testid=checks-note]",
    "/alignment/1": "[data-testid=alignment-picture]",
}
FOUND = """async () => {
  const { violations } = await axe.run(document, { resultTypes: ["violations"] });
  return violations
    .flatMap(({ id, nodes }) => nodes.map(({ target, any }) => [id, ...target, any[0]?.message ?? ""].join(" ")));
}"""


@pytest.mark.skipif(not AXE.is_file(), reason="axe-core is not installed; run scripts/setup test")
def test_no_page_has_a_problem(shared_page: Page, shop: Shop) -> None:
    page, project = shared_page, shop.new_project("proposed")
    found: dict[str, list[str]] = {}

    def look(what: str) -> None:
        if problems := page.evaluate(FOUND):
            found[what] = problems

    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        for path, there in PAGES.items():
            page.goto(f"/#/{project.path.name}{path}" if path else "/#/")
            page.reload()
            page.evaluate(AXE.read_text())
            expect(page.locator(there).first).to_be_visible()
            look(f"{scheme} {path}")
            for key, dialog in (("?", "key-table"), ("/", "class-dialog")) if path == "/annotate/1" else ():
                page.keyboard.press(key)
                expect(page.get_by_test_id(dialog)).to_be_visible()
                look(f"{scheme} {dialog}")
                page.keyboard.press("Escape")
                expect(page.get_by_test_id(dialog)).to_be_hidden()
    page.emulate_media(color_scheme=None)  # type: ignore[arg-type]
    assert found == {}
