"""Pages as people meet them, in a real browser (headless Chromium): on a phone, on a tablet, on a desk."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, sync_playwright
from playwright.sync_api import Page as Tab

from coec.cli.main import main
from coec.reports import page
from reports import pages

PHONE_PX = 360
WIDTHS_PX = (PHONE_PX, 768, 1600)

BAR_PX = 15
"""Of the scroll bar of a desk, which Playwright hides unless asked not to. A phone's takes no room."""

MOST_BYTES = 3_000_000

OBSERVATION = """() => ({
    wide: document.scrollingElement.scrollWidth, room: document.documentElement.clientWidth, inner: innerWidth,
    headings: [...document.querySelectorAll("h1,h2,h3,h4")].map(h => Number(h.tagName[1])),
    unnamed: [...document.querySelectorAll("img")].filter(i => !i.alt || !i.complete || !i.naturalWidth).length,
    lazy: document.querySelectorAll("[loading=lazy]").length,
    plots: [...document.querySelectorAll("svg:not([aria-hidden])")].filter(s => !s.getAttribute("aria-label")).length,
    lost: [...document.querySelectorAll("a[href^='#']")].map(a => a.getAttribute("href").slice(1))
        .filter(id => !document.getElementById(id)),
    away: [...document.querySelectorAll("a[href],[src]")].map(a => a.getAttribute("href") || a.getAttribute("src"))
        .filter(to => to && /^[a-z]+:|^\\/\\//i.test(to) && !to.startsWith("data:image/")),
    ids: [...document.querySelectorAll("[id]")].map(e => e.id),
    small: [...document.querySelectorAll("svg.plot")].filter(s => s.getBoundingClientRect().width > 0)
        .map(s => 12 * s.getBoundingClientRect().width / s.viewBox.baseVal.width),
    stuck: [...document.querySelectorAll(".scroll")].filter(s => s.scrollWidth > s.clientWidth && s.tabIndex !== 0)
        .length,
})"""
"""What of a page is to be looked at."""

SETTLED = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
"""A page hears of its new size before the next frame is drawn."""

ALIKE = {"detection", "dirty", "flagged", "hostile_calibration"}
"""Kinds that are laid out as others are."""

LEAST_LETTER_PX = 11.0
"""Of the labels of a plot, as they are shown."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One for the whole file."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("needs Chromium")
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as driver:
        started = driver.chromium.launch(
            executable_path=chromium, args=arguments, ignore_default_args=["--hide-scrollbars"]
        )
        yield started
        started.close()


def opened(browser: Browser, path: Path, **context: Any) -> tuple[Tab, list[str]]:
    """The page of a file, and all that goes wrong in it."""
    tab = browser.new_context(**context).new_page()
    wrong: list[str] = []
    tab.on("console", lambda message: wrong.append(message.text))
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("dialog", lambda dialog: wrong.append(dialog.message))
    tab.on("request", lambda request: wrong.append(request.url) if request.url.startswith("http") else None)
    tab.goto(path.as_uri())
    return tab, wrong


@pytest.mark.parametrize("kind", sorted(set(pages.KINDS) - ALIKE))
def test_a_page_fits_every_screen_and_loads_nothing(browser: Browser, tmp_path: Path, kind: str) -> None:
    path = page.write(tmp_path / "report.html", pages.KINDS[kind](tmp_path))
    assert path.stat().st_size <= MOST_BYTES
    tab, wrong = opened(browser, path)
    for width in WIDTHS_PX:
        tab.set_viewport_size({"width": width, "height": 900})
        bar = tab.add_style_tag(content=f"html::-webkit-scrollbar {{ width: {BAR_PX if width > PHONE_PX else 0}px }}")
        tab.evaluate(SETTLED)
        seen = tab.evaluate(OBSERVATION)
        bar.evaluate("tag => tag.remove()")
        assert seen["inner"] == width
        assert seen["wide"] <= seen["room"], "beside the scroll bar"
        assert all(letter_px >= LEAST_LETTER_PX for letter_px in seen["small"]), width
        assert seen["stuck"] == 0, "what scrolls is reached by the keyboard"
    assert wrong == []
    assert seen["headings"][0] == 1
    assert seen["headings"].count(1) == 1
    steps = zip(seen["headings"], seen["headings"][1:], strict=False)
    assert all(after - before <= 1 for before, after in steps), "no level is left out"
    assert (seen["unnamed"], seen["plots"], seen["lazy"]) == (0, 0, 0)
    assert (seen["lost"], seen["away"]) == ([], [])
    assert len(seen["ids"]) == len(set(seen["ids"]))
    tab.context.close()


def test_buttons_copy_every_digit(browser: Browser, tmp_path: Path) -> None:
    path = page.write(tmp_path / "report.html", pages.calibration(tmp_path))
    tab, wrong = opened(browser, path, permissions=["clipboard-read", "clipboard-write"])
    exact = pages.calibration_report().camera_from_lidar
    buttons = tab.locator("button[data-copy]")
    buttons.nth(0).focus()
    tab.keyboard.press("Enter")
    tab.get_by_text("Copied.").wait_for()
    copied = tab.evaluate("navigator.clipboard.readText().then(JSON.parse)")
    assert copied == [list(row) for row in exact.matrix]
    buttons.nth(1).click()
    tab.wait_for_function("navigator.clipboard.readText().then(text => !text.startsWith('['))")
    text = tab.evaluate("navigator.clipboard.readText()")
    assert [float(word) for word in text.split()] == [*exact.translation_m, *exact.quaternion_xyzw]
    assert wrong == []
    tab.context.close()


@pytest.mark.parametrize("refuses", [False, True])
def test_buttons_work_without_permission(browser: Browser, tmp_path: Path, refuses: bool) -> None:
    """By the older way, which asks for none; where that is refused, too, the text is left to be taken."""
    path = page.write(tmp_path / "report.html", pages.calibration(tmp_path))
    tab, wrong = opened(browser, path)
    tab.evaluate(
        """refuses => {
            Object.defineProperty(navigator, "clipboard", { value: undefined });
            addEventListener("copy", () => { window.taken = getSelection().toString(); });
            if (refuses) document.execCommand = () => false;
        }""",
        refuses,
    )
    button = tab.locator("button[data-copy]").first
    expected = button.get_attribute("data-copy")
    button.click()
    if refuses:
        tab.get_by_text("copy it with Ctrl+C").wait_for()
        area = tab.locator("textarea")
        assert area.is_visible()
        assert area.evaluate("a => a.value.slice(a.selectionStart, a.selectionEnd)") == expected
    else:
        tab.get_by_text("Copied.").wait_for()
        assert tab.evaluate("window.taken") == expected
        assert tab.locator("textarea").count() == 0
    assert wrong == []
    tab.context.close()


def test_the_slider_moves_between_both_pictures_by_the_keyboard(browser: Browser, tmp_path: Path) -> None:
    path = page.write(tmp_path / "report.html", pages.calibration(tmp_path))
    tab, _ = opened(browser, path)
    cut = "getComputedStyle(document.querySelector('.compare .after img')).clipPath"
    slider = tab.locator(".compare input[type=range]")
    slider.focus()
    tab.keyboard.press("End")
    assert tab.evaluate(cut) == "inset(0px 0px 0px calc(0% + 0px))" or "0%" in tab.evaluate(cut)
    tab.keyboard.press("Home")
    assert "100%" in tab.evaluate(cut)
    boxes = [tab.locator(f".compare .{side} img").bounding_box() for side in ("before", "after")]
    assert boxes[0] == boxes[1], "in one place"
    tab.emulate_media(media="print")
    left, right = (tab.locator(f".compare .{side} img").bounding_box() for side in ("before", "after"))
    assert left is not None
    assert right is not None
    assert left["x"] + left["width"] <= right["x"], "side by side on paper"
    tab.context.close()


def test_a_page_is_dark_where_that_is_requested(browser: Browser, tmp_path: Path) -> None:
    path = page.write(tmp_path / "report.html", pages.calibration(tmp_path))
    light_of = "getComputedStyle(document.body).{}.match(/\\d+/g).slice(0, 3).reduce((a, b) => a + Number(b), 0) / 765"
    tab, _ = opened(browser, path)
    for scheme in ("light", "dark"):
        tab.emulate_media(color_scheme=scheme)
        paper, ink = (tab.evaluate(light_of.format(name)) for name in ("backgroundColor", "color"))
        assert abs(paper - ink) > 0.6
        assert (paper < ink) is (scheme == "dark")
    tab.context.close()


def test_a_page_says_everything_without_a_script(browser: Browser, tmp_path: Path) -> None:
    path = page.write(tmp_path / "report.html", pages.calibration(tmp_path))
    tab, wrong = opened(browser, path, java_script_enabled=False)
    boxes = [tab.locator(f".compare .{side} img").bounding_box() for side in ("before", "after")]
    assert boxes[0] != boxes[1]
    assert not tab.locator(".compare input").is_visible()
    assert tab.get_by_text("T_camera_lidar, 4 × 4").is_visible()
    assert wrong == []
    tab.context.close()


def test_the_keyboard_comes_to_the_content_at_once(browser: Browser, tmp_path: Path) -> None:
    path = page.write(tmp_path / "report.html", pages.calibration(tmp_path))
    tab, _ = opened(browser, path)
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.textContent") == "To the content"
    assert tab.evaluate("document.activeElement.getBoundingClientRect().left") >= 0
    assert tab.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    tab.keyboard.press("Enter")
    assert tab.evaluate("document.activeElement.id") == "main"
    tab.context.close()


@pytest.mark.slow
def test_the_page_of_a_real_result(browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From frames to a page, with pictures as large as those of a vehicle."""
    pytest.importorskip("embreex", reason="needs ray casting")
    source = "sim:seed=1&seconds=24&camera_hz=0.5&lidar_hz=0.5&camera=fisheye1400&lidar=64&depth=yes"
    folder = tmp_path / "out"
    monkeypatch.setattr(
        sys, "argv", ["coec", "calibrate", source, "--depth", "stereo", "--perturb", "0.3,0,0", "--output", str(folder)]
    )
    main()
    path = folder / "report.html"
    assert path.stat().st_size <= MOST_BYTES
    tab, wrong = opened(browser, path)
    for width in WIDTHS_PX:
        tab.set_viewport_size({"width": width, "height": 900})
        assert tab.evaluate("document.scrollingElement.scrollWidth") <= width
    assert tab.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 600)")
    assert wrong == []
    tab.context.close()
