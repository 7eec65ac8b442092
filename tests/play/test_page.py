"""The page in a real browser, before a real server in a process of its own."""

import re
import time

import numpy as np

from acwm_formats.check import check_dataset
from tests.browsing import DESK, PHONE
from tests.play.pages import seen, shown, until


def dark(page):
    """How far to the right the pusher is in the simulator's picture, as a share of its width."""
    columns = np.nonzero(shown(page, "sim").max(-1) < 75)[1]
    return columns.mean() / 64 if len(columns) else np.nan


def white(page):
    """The same of the model's disc."""
    columns = np.nonzero(shown(page, "model").min(-1) > 250)[1]
    return columns.mean() / 64 if len(columns) else np.nan


WATCH = """() => {
  const look = () => {
    const board = document.querySelector('.board'), sim = document.getElementById('sim');
    if (board && board.checkVisibility()) {
      const { data } = sim.getContext('2d').getImageData(0, 0, sim.width, sim.height);
      window.looks = (window.looks || 0) + 1;
      if (!data.some(each => each)) window.blank = true;
    }
    requestAnimationFrame(look);
  };
  look();
}"""


def test_no_picture_is_shown_before_there_is_one(browser, served):
    page = browser.new_page(viewport=DESK)
    page.add_init_script(f"({WATCH})()")
    page.goto(served.url)
    until(page, "Number(document.body.dataset.alone) > 0")
    assert page.evaluate("() => [window.looks > 0, Boolean(window.blank)]") == [True, False]
    assert not page.locator(".setup").is_visible()
    page.evaluate("() => hear({ type: 'busy', text: 'Setting up another …' })")
    assert page.get_by_text("Setting up another …").is_visible()
    assert not page.locator(".board").is_visible()
    page.close()


def test_keys_move_the_pusher_in_both_pictures(page):
    for key, there in (("ArrowLeft", lambda at: at < 0.2), ("ArrowRight", lambda at: at > 0.8)):
        page.keyboard.down(key)
        seen(page, lambda there=there: there(dark(page)) and there(white(page)))
        page.keyboard.up(key)
    assert shown(page, "diff").max() > 100  # the cubes of the model stay


def test_dragging_in_a_picture_moves_it_there(page):
    box = page.locator("#model").bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"], steps=5)
    page.mouse.up()
    seen(page, lambda: abs(dark(page) - 0.25) < 0.05 and abs(white(page) - 0.25) < 0.05)


def test_a_point_is_dragged_to_another_place(page):
    box = page.locator("#model").bounding_box()
    page.keyboard.press("k")
    until(page, "document.querySelectorAll('.model .dot').length === 1")
    page.mouse.move(box["x"] + 0.52 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.7 * box["height"], steps=5)
    page.mouse.up()
    alone = float(page.evaluate("() => document.body.dataset.alone"))
    until(page, f"Number(document.body.dataset.alone) > {alone + 1}")
    at = page.evaluate("() => keypoints")  # as the server says
    np.testing.assert_allclose(at, [[0, 0.2, 0.7]], atol=0.02)
    until(page, "document.body.classList.contains('uncompared')")
    page.keyboard.press("x")
    until(page, "!document.body.classList.contains('uncompared')")
    until(page, "keypoints[0][1] === 0.5")


def test_a_finger_does_as_well(browser, served):
    context = browser.new_context(viewport=PHONE, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(served.url)
    until(page, "Number(document.body.dataset.alone) > 0")
    box = page.locator("#sim").bounding_box()
    page.touchscreen.tap(box["x"] + 0.7 * box["width"], box["y"] + 0.4 * box["height"])
    seen(page, lambda: abs(dark(page) - 0.7) < 0.05 and abs(white(page) - 0.7) < 0.05)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= PHONE["width"]
    context.close()


def test_buttons_for_scenes_and_the_models_state(page):
    first = page.evaluate("() => document.body.dataset.scene")
    until(page, "Number(document.body.dataset.alone) > 1")
    page.keyboard.press("x")
    until(page, "Number(document.body.dataset.alone) < 1")
    page.get_by_role("button", name="Same scene").click()
    until(page, "Number(document.body.dataset.alone) < 0.5")
    assert page.evaluate("() => document.body.dataset.scene") == first
    page.get_by_role("button", name="New scene").click()
    until(page, f"document.body.dataset.scene !== '{first}'")
    page.get_by_role("button", name="Pause").click()
    until(page, "document.getElementById('link-text').textContent === 'paused'")
    alone = float(page.evaluate("() => document.body.dataset.alone"))
    for step in (1, 2, 3):  # one may have been under way when it was paused
        page.get_by_role("button", name="Step").click()
        until(page, f"document.body.dataset.alone > {alone + 0.4 * step - 0.01}")
    after = float(page.evaluate("() => document.body.dataset.alone"))
    assert min(abs(after - alone - 0.4 * steps) for steps in (3, 4)) < 0.01


def test_a_factor_goes_out_of_distribution(page):
    page.get_by_label("cube count").select_option(label="5 · not in training")
    until(page, "document.querySelector('#badges .ood')")
    assert "out of distribution: cube count=5" in page.inner_text("#badges")
    page.get_by_role("button", name="reset all").click()
    until(page, "!document.querySelector('#badges .ood')")


def test_figures_come_in_physical_units(page):
    until(page, "/ cm/.test(document.querySelector('[data-name=position_error] dd').textContent)")
    assert re.fullmatch(r"\d+ %", page.inner_text("[data-name=mask_iou] dd"))
    until(page, "/ s$/.test(document.querySelector('[data-name=alone] dd').textContent)")


def test_a_recording_can_be_checked(page, served):
    page.keyboard.press("p")  # the policy drives
    page.get_by_role("button", name="Record").click()
    until(page, "/Stop · [1-9]/.test(document.getElementById('record').textContent)")
    page.keyboard.press("v")
    until(page, "/Saved .* as episode/.test(document.getElementById('notice').textContent)")
    folder = served.out / "push_cube-64x64"
    assert [item.problem for item in check_dataset(folder) if item.problem] == []
    assert list(served.out.glob("*.mp4"))


def test_a_killed_server_is_told_and_found_again(browser, served):
    page = browser.new_page(viewport=DESK)
    page.goto(served.url)
    until(page, "Number(document.body.dataset.alone) > 0")
    scene = page.evaluate("() => document.body.dataset.scene")
    served.kill()
    until(page, "!document.getElementById('banner').hidden")
    assert "does not respond" in page.inner_text("#banner")
    served.start()
    until(page, "document.getElementById('banner').hidden")
    page.evaluate("() => { document.body.dataset.alone = 0; }")
    until(page, "Number(document.body.dataset.alone) > 0")
    assert page.evaluate("() => document.body.dataset.scene") == scene  # the same one goes on
    page.close()


def test_another_page_may_not_play(browser, served):
    """A page of another origin that knows the address gets no socket."""
    page = browser.new_page()
    page.goto("data:text/html,<title>stranger</title>")
    address = served.url.replace("http:", "ws:") + "socket"
    said = page.evaluate(
        """(address) => new Promise((tell) => {
          const socket = new WebSocket(address);
          socket.onopen = () => tell("open");
          socket.onerror = () => tell("refused");
        })""",
        address,
    )
    assert said == "refused"
    page.close()


def test_another_world_is_chosen_in_the_menu(page):
    page.locator("#world").select_option("reacher")
    until(page, "document.getElementById('how').textContent.includes('joystick')")
    page.keyboard.press("b")
    until(page, "Number(document.body.dataset.alone) > 0.5")
    assert "forearm mass" in page.inner_text("#factors").lower()


def test_slow_motion_slows_both_pictures(page):
    """A second takes four; a busy machine only makes it slower still."""
    page.get_by_role("radio", name="¼×").check()
    page.get_by_role("button", name="Same scene").click()
    until(page, "Number(document.body.dataset.alone) < 0.5")
    until(page, "Number(document.body.dataset.alone) > 0.7")
    began = time.monotonic()
    until(page, "Number(document.body.dataset.alone) > 1.5")
    assert time.monotonic() - began > 2
    page.get_by_role("radio", name="1×").check()


def test_a_gamepad_steers_and_presses_buttons(browser, served):
    page = browser.new_page(viewport=DESK)
    page.add_init_script(
        """window.stick = { axes: [0, 0, 0, 0],
             buttons: Array.from({ length: 16 }, () => ({ pressed: false, value: 0 })) };
           navigator.getGamepads = () => [window.stick];"""
    )
    page.goto(served.url)
    until(page, "Number(document.body.dataset.alone) > 1")
    page.evaluate("() => { window.stick.axes[0] = 1; }")
    seen(page, lambda: dark(page) > 0.8 and white(page) > 0.8)
    page.evaluate("() => { window.stick.buttons[0].pressed = true; }")  # A takes over
    until(page, "Number(document.body.dataset.alone) < 1")
    page.evaluate("() => { window.stick.buttons[9].pressed = true; }")
    until(page, "document.getElementById('link-text').textContent === 'paused'")
    page.close()


def test_the_page_is_dark_where_the_system_is(browser, served):
    shades = []
    for scheme in ("light", "dark"):
        page = browser.new_page(color_scheme=scheme)
        page.goto(served.url)
        look = "() => getComputedStyle(document.body).backgroundColor"
        shades.append(sum(map(int, re.findall(r"\d+", page.evaluate(look))[:3])))
        page.close()
    assert shades[0] > 600 > 200 > shades[1]
