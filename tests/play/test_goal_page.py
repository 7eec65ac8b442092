"""The page while a driver acts towards a goal, in a real browser."""

import numpy as np

from tests.browsing import PHONE
from tests.play.pages import seen, shown, until
from tests.play.test_page import dark

SOLVED = "document.getElementById('phase').dataset.kind === 'solved'"


def test_the_planner_drives_until_the_person_takes_over(page):
    assert not page.locator("#attempt").is_visible()
    page.get_by_role("radio", name="Planner").check()
    until(page, "/^planning … +[0-9.]+ s$/.test(document.getElementById('phase').textContent)")
    assert page.locator("#attempt").is_visible()
    goal = shown(page, "goal")
    assert goal.shape == (64, 64, 3)
    assert np.ptp(goal) > 100
    assert "place" in page.inner_text("#aim")
    assert page.locator("#task option").all_inner_texts() == ["place", "place and turn"]
    assert page.inner_text("[data-name=distance] dd").endswith("cm")
    assert page.inner_text("[data-name=distance] small") == "solved within 1.5 cm"
    until(page, "document.querySelector('[data-name=decision] dd').textContent.endsWith(' s')")
    until(page, "document.getElementById('phase').dataset.kind === 'planning'")
    page.keyboard.down("ArrowLeft")
    seen(page, lambda: dark(page) < 0.2)
    page.keyboard.up("ArrowLeft")
    assert page.locator("input[name=driver][value=you]").is_checked()
    assert not page.locator("#phase").is_visible()
    assert page.locator("#attempt").is_visible()  # the goal is the person's now
    assert page.locator("#task").is_disabled()
    page.keyboard.press("n")
    until(page, "document.getElementById('attempt').hidden")
    assert page.locator("[data-name=distance]").count() == 0


def test_a_solved_goal_is_told_and_the_picture_rests(page):
    page.get_by_role("radio", name="Replay").check()  # it needs the start of a scene
    page.get_by_role("button", name="Same scene").click()
    until(page, SOLVED)
    assert page.inner_text("#phase") == "solved ✓"
    until(page, "document.getElementById('link-text').textContent === 'solved ✓'")
    assert (shown(page, "sim") != shown(page, "goal")).any(-1).mean() < 0.2
    page.locator("#task").select_option("place_and_turn")
    until(page, "document.getElementById('aim').textContent.includes('corner')")


def test_a_goal_fits_on_a_phone(browser, served):
    context = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(served.url)
    until(page, "Number(document.body.dataset.alone) > 0")
    page.get_by_role("radio", name="Stuck").tap()
    until(page, "document.getElementById('phase').dataset.kind === 'planning'")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    until(page, "document.getElementById('link-text').textContent === 'planning …'")
    page.get_by_role("radio", name="You").tap()
    until(page, "document.getElementById('phase').hidden")
    page.evaluate("() => { document.body.dataset.alone = 0; }")
    until(page, "Number(document.body.dataset.alone) > 0")  # it goes on
    context.close()
