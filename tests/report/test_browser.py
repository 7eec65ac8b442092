"""The pages in a real browser: no errors, nothing fetched, nothing wider than a phone."""

import numpy as np
import pytest

from acwm_core.evaluation.results import Summary, VideoRecord
from acwm_core.evaluation.videos import case_study
from acwm_report.leaderboard import write_leaderboard
from acwm_report.page import write_report
from tests.browsing import DESK, PHONE
from tests.report import synthetic
from tests.report.test_plans import add_plans

BROKEN_WORDS = """() => [...document.querySelectorAll('tbody th')].flatMap(cell => {
  const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT), broken = [];
  while (walker.nextNode()) {
    for (const word of walker.currentNode.data.matchAll(/(?<![\\w+-])[A-Za-z]+(?![\\w+-])/g)) {
      const range = document.createRange();
      range.setStart(walker.currentNode, word.index);
      range.setEnd(walker.currentNode, word.index + word[0].length);
      if (range.getClientRects().length > 1) broken.push(word[0]);
    }
  }
  return broken;
})"""
"""Words in the names of rows that a line ends within; names of runs may have to be broken."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A report of one run with a video and a video, one of five runs, and a leaderboard."""
    root = tmp_path_factory.mktemp("browser")
    rng = np.random.default_rng(3)
    runs = []
    for number in range(5):
        scores = rng.normal(24, 2, 12)
        rows = [*synthetic.clips(scores), *synthetic.clips(scores - 2, "ood_test")]
        environment = "drift" if number < 4 else "reacher"
        name = f"push_cube_cross_attention_with_a_long_name+small-{number}"
        runs.append(synthetic.run(root / name, rows, environment=environment))
    add_video(runs[0], masked=True)
    add_video(runs[1], masked=False)
    add_plans(runs[0])
    one = write_report(runs[:1], root / "one.html")
    many = write_report(runs, root / "many.html")
    board, _ = write_leaderboard(root)
    return {"one": one, "many": many, "board": board}


def add_video(run, masked):
    """Give a run a video of its third clip: red grows brighter, and is predicted as fading blue."""
    import torch

    from acwm_core.data.video import write_mp4

    shades = torch.linspace(0.5, 1, 5)[:, None, None].expand(5, 32, 32)
    truth, prediction = torch.zeros(2, 5, 3, 32, 32)
    truth[:, 0], prediction[:, 2] = shades, shades.flip(0)
    names, frames = case_study(truth, prediction, np.full((5, 32, 32), masked, np.uint8))
    record = VideoRecord(
        file="ind_test-000003-model.mp4",
        split="ind_test",
        episode=3,
        ood_label=None,
        pick="median",
        kind="model",
        values={"psnr": 21.0},
        actions=[[0.5]] * 5,
        panels=names,
    )
    folder = run / "evaluation"
    (folder / "videos").mkdir()
    write_mp4(folder / "videos" / record.file, frames, 10, 4)
    summary = Summary.read(run)
    summary.videos.append(record)
    summary.write(folder)


def visit(browser, file, size, **options):
    context = browser.new_context(viewport=size, **options)
    page, problems = context.new_page(), []
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: note_request(request.url, problems))
    page.goto(file.as_uri())
    return page, problems


def note_request(url, problems):
    if not url.startswith(("file:", "data:", "blob:")):
        problems.append(f"asked for {url}")


@pytest.mark.parametrize("name", ["one", "many", "board"])
@pytest.mark.parametrize("size", [PHONE, DESK], ids=["phone", "desk"])
def test_pages_open_without_errors_and_fit(browser, pages, name, size):
    page, problems = visit(browser, pages[name], size)
    for details in page.locator("details").all():
        details.evaluate("each => { each.open = true; }")
    page.wait_for_timeout(100)
    assert problems == []
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    assert page.evaluate(BROKEN_WORDS) == []
    # Text of every figure is inside its drawing: nothing is cut off.
    assert page.locator("svg text").count() > 0 or name == "board"
    page.context.close()


def column(page, index):
    return page.evaluate(
        "k => [...document.querySelector('table[data-sortable]').tBodies[0].rows]"
        ".map(row => row.cells[k].firstChild?.textContent.trim() ?? '')",
        index,
    )


def test_headings_sort_both_ways_by_number_and_by_word_also_with_keys(browser, pages):
    page, problems = visit(browser, pages["one"], DESK)
    heads = page.locator("table[data-sortable] thead tr:last-child th")
    titles = [text.split("\n")[0] for text in heads.all_inner_texts()]
    score = next(i for i, title in enumerate(titles) if title.startswith("PSNR"))
    button = heads.nth(score).locator("button")
    for order, name in (("ascending", False), ("descending", True)):
        button.focus()
        page.keyboard.press("Enter")
        assert heads.nth(score).get_attribute("aria-sort") == order
        values = [float(text) for text in column(page, score)]
        assert values == sorted(values, reverse=name)
    heads.nth(0).locator("button").click()
    episodes = [int(text) for text in column(page, 0)]
    assert episodes == sorted(episodes)
    assert heads.nth(score).get_attribute("aria-sort") is None
    heads.nth(1).locator("button").click()
    assert column(page, 1) == sorted(column(page, 1))
    assert problems == []
    page.context.close()


def wait_until(page, condition):
    """As `wait_for_function`, which needs the `eval` that the page's own policy forbids."""
    for _ in range(600):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(100)
    raise AssertionError(condition)


def test_a_row_leads_to_its_video_which_plays(browser, pages):
    page, problems = visit(browser, pages["one"], DESK)
    page.get_by_role("link", name="▶ play").click()
    video = page.locator("video").first
    video.scroll_into_view_if_needed()
    assert video.bounding_box()["y"] < DESK["height"]
    wait_until(page, "document.querySelector('video').readyState >= 2")
    assert video.evaluate("each => each.videoWidth") == 4 * (2 * 32 + 2)
    assert problems == []
    page.context.close()


PIXELS = """each => {
  const { data } = each.getContext('2d').getImageData(0, 0, each.width, each.height);
  return [...data].filter((_, k) => k % 4 < 3);
}"""
PLAYING = "[...document.querySelectorAll('video')].filter(each => !each.paused).length"


def pixels(canvas):
    """The pixels of a canvas, `[H * W, 3]`."""
    return np.array(canvas.evaluate(PIXELS)).reshape(-1, 3)


def test_the_first_screen_moves_and_tells_three_figures(browser, pages):
    page, _ = visit(browser, pages["one"], DESK)
    panels = page.locator("header canvas").all()
    figures = page.locator("header .figures div").all()
    assert [len(panels), len(figures)] == [3, 3]
    for each in [*panels, *figures, page.locator("h1"), page.get_by_role("button", name="Pause")]:
        box = each.bounding_box()
        assert box["y"] + box["height"] <= DESK["height"]
    truth = set()
    for _ in range(600):
        truth.add(int(pixels(panels[0])[:, 0].mean().round(-1)))
        if len(truth) > 2:
            break
        page.wait_for_timeout(50)
    assert len(truth) > 2, "the truth does not move"
    page.context.close()


@pytest.mark.parametrize("run", ["run1", "run2"])
def test_panels_are_cut_out_of_videos_with_and_without_masks(browser, pages, run):
    page, _ = visit(browser, pages["many"], DESK)
    truth, prediction, _ = page.locator(f".moving[data-of^='{run}-'] canvas").all()
    truth.scroll_into_view_if_needed()
    for _ in range(600):
        red, blue = pixels(truth), pixels(prediction)
        if red.any() and blue.any():
            break
        page.wait_for_timeout(50)
    assert red[:, 0].min() > 100
    assert red[:, 1:].max() < 40
    assert blue[:, 2].min() > 100
    assert blue[:, :2].max() < 40
    page.context.close()


def test_one_button_plays_and_pauses_all_videos_also_with_keys(browser, pages):
    page, problems = visit(browser, pages["one"], {"width": 1280, "height": 20000})
    for details in page.locator("details").all():
        details.evaluate("each => { each.open = true; }")
    count = page.locator("video").count()
    assert count == 2
    assert page.get_by_role("group", name="All videos").get_by_role("button").count() == 1
    assert not page.evaluate("[...document.querySelectorAll('video')].some(each => each.controls)")
    wait_until(page, f"{PLAYING} === {count}")
    page.get_by_role("button", name="Pause").focus()
    page.keyboard.press("Space")
    wait_until(page, f"{PLAYING} === 0")
    slider = page.get_by_label("Position in the videos")
    slider.fill("0.5")
    share = "document.querySelector('video').currentTime / document.querySelector('video').duration"
    wait_until(page, f"Math.abs({share} - 0.5) < 0.1")
    page.get_by_role("button", name="Play").focus()
    page.keyboard.press("Enter")
    wait_until(page, f"{PLAYING} === {count}")
    assert problems == []
    page.context.close()


def test_who_asked_for_less_motion_begins_with_still_pictures(browser, pages):
    page, _ = visit(browser, pages["one"], DESK, reduced_motion="reduce")
    assert page.get_by_role("button", name="Play").count() == 1
    assert page.evaluate(PLAYING) == 0
    page.context.close()


def test_links_to_folded_runs_and_pages_without_scripts(browser, pages):
    page, _ = visit(browser, pages["many"], PHONE)
    page.locator("a[href='#run3']").first.click()
    near = "document.querySelector('#run3').getBoundingClientRect().top < innerHeight / 2"
    wait_until(page, near)  # it scrolls smoothly
    page.context.close()
    page, problems = visit(browser, pages["one"], PHONE, java_script_enabled=False)
    assert page.locator("table[data-sortable] tbody tr").count() == 24
    assert page.locator("video[controls]").first.is_visible()
    assert not page.locator(".player, .moving").first.is_visible()
    assert problems == []
    page.context.close()


def test_the_leaderboard_is_filtered(browser, pages):
    page, problems = visit(browser, pages["board"], PHONE)
    assert page.locator(".board:visible").count() == 2
    page.get_by_label("Environment").select_option("reacher")
    assert page.locator(".board:visible h2").all_inner_texts() == ["reacher"]
    page.get_by_label("Environment").select_option("")
    assert page.locator(".board:visible").count() == 2
    assert problems == []
    page.context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_stand_out_from_their_ground(browser, pages, scheme):
    """The contrast of all text that is set in one of the page's inks, as WCAG measures it."""
    page, _ = visit(browser, pages["one"], DESK, color_scheme=scheme)
    colours = page.evaluate(
        "() => Object.fromEntries(['ink', 'muted', 'paper', 'card', 'soft', 'model', 'bad'].map("
        "name => [name, getComputedStyle(document.documentElement)"
        ".getPropertyValue('--' + name).trim()]))"
    )
    for ink in ("ink", "muted", "model", "bad"):
        for ground in ("paper", "card", "soft"):
            assert contrast(colours[ink], colours[ground]) >= 4.5, (ink, ground)
    page.context.close()


def contrast(first, second):
    low, high = sorted(luminance(colour) for colour in (first, second))
    return (high + 0.05) / (low + 0.05)


def luminance(colour):
    channels = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
