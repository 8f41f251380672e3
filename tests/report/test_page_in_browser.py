"""The page in a real browser: pictures show, sliders move, keys work, nothing is complained about or asked for."""

from dataclasses import replace

import chromium
import pytest

from torchdeform.report import write_report

WIDTH = 1280


@pytest.fixture(scope="module")
def running():
    program = chromium.find_chromium()
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with chromium.Browser(program) as browser:
        yield browser


@pytest.fixture
def browser(running):
    """The browser, as a person finds it; at the end nothing was complained about, and nothing fetched."""
    running.complaints.clear()
    running.requests.clear()
    running.resize(WIDTH, 900)
    running.prefer(prefers_color_scheme="light", prefers_reduced_motion="no-preference")
    yield running
    assert running.complaints == []
    assert [url for url in running.requests if not url.startswith(("file:", "data:"))] == []


@pytest.fixture(params=[2, 3])
def page(request, browser, tmp_path, make_full):
    """A page with everything, open, and its number of planes."""
    write_report(tmp_path / "report.html", *make_full(request.param))
    browser.open(tmp_path / "report.html")
    return {2: 1, 3: 3}[request.param]


def _value(browser, selector: str) -> str:
    return browser.run(f"document.querySelector('{selector}').value")


def _focus(browser, selector: str) -> None:
    browser.run(f"document.querySelector('{selector}').focus()")


def test_every_picture_shows(browser, page):
    shown = browser.run(
        "[...document.images].map(image => [image.naturalWidth, image.clientWidth, image.clientHeight])"
    )
    assert len(shown) == page * (10 + 3)  # ten pictures, two in the comparison, one below the grid
    assert all(min(sizes) > 20 for sizes in shown)
    curves = browser.run("[...document.querySelectorAll('.curve svg')].map(svg => svg.getBoundingClientRect().height)")
    assert len(curves) == 2
    assert min(curves) > 80
    ratio = browser.run(
        "[...document.images].map(i => i.clientWidth / i.clientHeight / "
        "parseFloat(getComputedStyle(i).getPropertyValue('--shape')))"
    )
    assert ratio == pytest.approx([1.0] * len(ratio), abs=0.03)


def test_slices_move_with_the_arrow_keys(browser, page):
    """All pictures of a plane follow; those of the others stay."""
    if page == 1:
        assert browser.run("document.querySelectorAll('.slice-number').length") == 0
        return
    at = "[...document.querySelectorAll('img.slice')].map(i => [i.dataset.plane, getComputedStyle(i).objectPosition])"
    before = browser.run(at)
    grid = "document.querySelector(document.querySelector('.grid use').getAttribute('href')).getAttribute('d')"
    path = browser.run(grid)
    _focus(browser, "input[data-plane=axial]")
    browser.press("ArrowRight")
    moved = browser.run(at)
    assert {plane for (plane, a), (_, b) in zip(before, moved, strict=True) if a != b} == {"axial"}
    assert all((a != b) == (plane == "axial") for (plane, a), (_, b) in zip(before, moved, strict=True))
    assert browser.run(grid) != path
    browser.press("ArrowLeft")
    assert browser.run(grid) == path
    assert "of 20" in browser.run("document.querySelector('output[data-plane=axial]').textContent")


def test_it_opens_at_the_worst_place(browser, page):
    """The sliders start there, and a button takes them back; the place has a ring."""
    rings = browser.run("[...document.querySelectorAll('.stage use.worst')].map(u => u.getBoundingClientRect().width)")
    assert len(rings) == page
    assert min(rings) > 5
    if page == 3:
        values = "[...document.querySelectorAll('.slice-number')].map(input => input.value)"
        start = browser.run(values)
        _focus(browser, "input[data-plane=coronal]")
        browser.press("Home" if int(start[1]) else "End")
        assert browser.run(values) != start
        _focus(browser, "#worst")
        browser.press("Enter")
        assert browser.run(values) == start


def test_what_is_drawn_is_shown_and_hidden(browser, page):
    """Every kind of mark has its box in the legend and is visible until it is cleared."""
    kinds = browser.run("[...document.querySelectorAll('input[name=shown]')].map(input => input.value)")
    assert set(kinds) - {"no-data"} == {"outlines", "landmarks", "masks", "absent", "worst", "tissue"}
    for kind in kinds if page == 3 else set(kinds) - {"no-data"}:  # in 2D the map stays inside the moving image
        drawn = f"[...document.querySelectorAll('.stage use.{kind}:not([hidden])')]"
        seen = f"{drawn}.filter(u => getComputedStyle(u).visibility == 'visible' && u.getBBox().width > 0).length"
        assert browser.run(seen) > 0, kind
        _focus(browser, f"input[value={kind}]")
        browser.press("Space")
        assert browser.run(seen) == 0, kind
        browser.press("Space")
        assert browser.run(seen) > 0, kind


def test_marks_follow_the_image_that_is_compared(browser, page):
    """Outlines and arrows are those of the image that is chosen, besides those of the fixed one."""
    images = "[...new Set([...document.querySelectorAll('.stage use:not([hidden])')].map(u => u.dataset.image))].sort()"
    assert browser.run(images) == ["fixed", "warped"]
    _focus(browser, "input[value=warped]")
    browser.press("ArrowRight")
    assert browser.run(images) == ["fixed", "moving"]


def test_the_line_moves_by_key_and_by_mouse(browser, page):
    clip = "getComputedStyle(document.querySelector('.above')).clipPath"
    assert "50%" in browser.run(clip)
    _focus(browser, "#swipe")
    browser.press("ArrowRight")
    assert "51%" in browser.run(clip)
    browser.run("document.querySelector('.stage').scrollIntoView({block: 'center'})")
    box = browser.run("(b => [b.x, b.y, b.width, b.height])(document.querySelector('.stage').getBoundingClientRect())")
    middle = box[1] + box[3] / 2
    browser.drag((box[0] + box[2] * 0.5, middle), (box[0] + box[2] * 0.25, middle))
    assert abs(float(_value(browser, "#swipe")) - 25) <= 1
    assert f"{_value(browser, '#swipe')}%" in browser.run(clip)


def test_images_are_compared_in_every_way(browser, page):
    """The arrow keys go through the ways; each shows its own control, and flickering starts and stops."""
    style = "getComputedStyle(document.querySelector('.above'))"
    hidden = f"{style}.visibility == 'hidden'"
    _focus(browser, "input[value=swipe]")
    browser.press("ArrowRight")
    assert browser.run("document.querySelector('.stages').dataset.mode") == "flicker"
    seen = browser.run(
        "new Promise(done => { const seen = new Set(); const timer = setInterval(() => {"
        f"seen.add({hidden}); if (seen.size == 2) {{ clearInterval(timer); done(true) }} }}, 50) }})"
    )
    assert seen
    _focus(browser, "#swap")
    before = browser.run("document.querySelector('.stages').classList.contains('first')")
    browser.press("Space")
    assert not browser.run("document.getElementById('auto').checked")
    assert browser.run("document.querySelector('.stages').classList.contains('first')") in (before, not before)
    now = browser.run(hidden)
    browser.press("Space")
    assert browser.run(hidden) != now
    _focus(browser, "input[value=flicker]")
    browser.press("ArrowRight")
    assert "conic-gradient" in browser.run(f"{style}.maskImage")
    browser.press("ArrowRight")
    assert browser.run(f"{style}.mixBlendMode") == "plus-lighter"
    visible = "[...document.querySelectorAll('.controls .only')].filter(e => e.offsetParent).length"
    assert browser.run(visible) == 1


def test_another_image_is_chosen(browser, page):
    """Both layers keep showing pictures, and the words follow."""
    source = "document.querySelector('.above img').src.slice(-200)"
    first = browser.run(source)
    _focus(browser, "input[value=warped]")
    browser.press("ArrowRight")
    assert browser.run(source) != first
    assert browser.run("document.querySelector('.stage .other-title').textContent") == "moving, aligned"


@pytest.mark.parametrize("dim", [2, 3])
def test_a_light_page_works_as_well(browser, tmp_path, make_full, dim):
    """Every image and every way to compare is there, but no picture of the map; it is smaller."""
    report_data, record = make_full(dim)
    write_report(tmp_path / "full.html", report_data, record)
    write_report(tmp_path / "light.html", replace(report_data, light=True), record)
    assert (tmp_path / "light.html").stat().st_size < 0.9 * (tmp_path / "full.html").stat().st_size
    browser.open(tmp_path / "light.html")
    browser.run("document.querySelectorAll('input[name=other], input[name=mode]').forEach(input => input.click())")
    assert browser.run("document.querySelectorAll('.grid, [data-name=log_det]').length") == 0
    assert browser.run("document.querySelectorAll('input[name=other]').length") == 2
    assert browser.run("document.querySelectorAll('.curve svg').length") == 2


def test_less_motion_means_no_flicker(browser, tmp_path, make_full):
    browser.prefer(prefers_reduced_motion="reduce")
    write_report(tmp_path / "report.html", *make_full(2))
    browser.open(tmp_path / "report.html")
    assert not browser.run("document.getElementById('auto').checked")


def test_a_picture_can_be_enlarged(browser, page):
    width = "document.querySelector('#picture-log_det').offsetWidth"
    before = browser.run(width)
    _focus(browser, "#picture-log_det .enlarge")
    browser.press("Enter")
    assert browser.run(width) > 1.5 * before
    assert browser.run("document.querySelector('#picture-log_det .enlarge').getAttribute('aria-expanded')") == "true"


@pytest.mark.parametrize("width", [320, 400, 760, 1280, 2200])
def test_no_window_is_too_narrow(browser, page, width):
    browser.resize(width, 800)
    assert browser.run("document.documentElement.scrollWidth") <= width


def test_all_controls_are_reached_by_tab(browser, page):
    """Tab goes through everything that can be operated, in the order of the page, and shows where it is."""
    browser.run("document.body.focus()")
    seen = []
    for _ in range(60):
        browser.press("Tab")
        name = browser.run(
            "(e => e.id || e.dataset.plane || e.name || e.className || e.tagName)(document.activeElement)"
        )
        if name in seen and name == "BODY":
            break
        seen.append(name)
        if name != "BODY":
            assert browser.run("getComputedStyle(document.activeElement).outlineStyle") != "none", name
    for name in ("skip", "other", "mode", "swipe", "enlarge", "copy", *(["axial", "sagittal"] if page == 3 else [])):
        assert name in seen, name


def _brightness(browser, what: str) -> float:
    found = browser.run(
        f"getComputedStyle(document.querySelector('{what}')).backgroundColor.match(/[0-9.]+/g).slice(0, 3)"
    )
    return sum(map(float, found)) / 3


def test_dark_is_dark(browser, page):
    assert _brightness(browser, "body") > 200
    browser.prefer(prefers_color_scheme="dark")
    assert _brightness(browser, "body") < 60
    colour = browser.run("getComputedStyle(document.querySelector('.curve text')).fill.match(/[0-9.]+/g).map(Number)")
    assert min(colour[:3]) > 150


def test_it_prints_light_without_controls(browser, page):
    browser.send("Emulation.setEmulatedMedia", media="print", features=[])
    try:
        assert _brightness(browser, "figure") == 255
        assert browser.run("getComputedStyle(document.querySelector('.controls')).display") == "none"
    finally:
        browser.send("Emulation.setEmulatedMedia", media="", features=[])


def test_the_page_is_looked_at_in_pixels(browser, page, tmp_path):
    """The comparison is not one colour: its pictures really are painted."""
    from torchdeform.io import read_image

    browser.picture(tmp_path / "page.png", whole=False)
    assert read_image(tmp_path / "page.png").data[0, :3].std() > 20
