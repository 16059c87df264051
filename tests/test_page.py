"""The page: its text and structure always, and where Chromium is installed what a reader sees and does."""

import html.parser
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import browser, installed

import jaxfilt as jf
from jaxfilt import report
from jaxfilt.bound import Bound
from jaxfilt.report.tables import Cell, cards, number, tables
from jaxfilt.study import study

EVIL = "<script>alert('x')</script>"
END, SPACE, TAB = "\ue010", "\ue00d", "\ue004"


def model(theta):
    return jf.linear(A=jnp.eye(2), H={EVIL: jnp.eye(2)}, Q=0.1 * jnp.eye(2), R={EVIL: theta["<i>"] * jnp.eye(2)})


def belief(theta):
    return jf.Gaussian(jnp.zeros(2), jnp.eye(2))


FILTERS = {"kf": lambda theta: jf.kf(model(theta)), EVIL: lambda theta: jf.kf(model({"<i>": theta["<i>"] / 4}))}
BLOCKS = {"place": ((0, 1), "m"), EVIL: ((1,), "<m>")}


@pytest.fixture(scope="module")
def found():
    """One filter that is right, one whose name and R are bad."""
    log = jf.schedule(model({"<i>": 1.0}), 40, 0.1)
    theta = {"<i>": 1.0}
    cov = np.broadcast_to(0.05 * np.eye(2), (40, 2, 2))
    bound = Bound(cov, 2 * cov, True, f"exact: {EVIL}")
    result = study(model, FILTERS, belief, log, jax.random.key(0), theta=theta, runs=60, blocks=BLOCKS)
    return result, bound


@pytest.fixture(scope="module")
def file(found, tmp_path_factory):
    result, bound = found
    out = tmp_path_factory.mktemp("page")
    return report.write(result, out, EVIL, bound=bound, command=f"jaxfilt study '{EVIL}'") / "report.html"


class Reader(html.parser.HTMLParser):
    """Elements with their attributes, and whether each is closed by its own end."""

    def __init__(self, page):
        super().__init__()
        self.elements, self.open, self.words = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def test_what_a_user_named_is_text_and_nothing_else(file):
    reader = Reader(file.read_text())
    assert not reader.open
    assert len(reader.all("script")) == 1
    assert not reader.all("i")
    assert not reader.all("m")
    assert sum(EVIL in words for words in reader.words) > 10
    assert EVIL in " ".join(image["alt"] for image in reader.all("img")) or EVIL in "".join(reader.words)
    assert not [name for _, attributes in reader.elements for name in attributes if name.startswith("on")]


def test_nothing_is_loaded_from_anywhere(file):
    page = file.read_text()
    reader = Reader(page)
    for _, attributes in reader.elements:
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith("data:")
    assert not re.search(r"url\(|@import", page)
    (policy,) = [m["content"] for m in reader.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy
    assert file.stat().st_size < 3e6


def test_the_page_can_be_read_without_eyes(file):
    reader = Reader(file.read_text())
    assert [attributes["lang"] for attributes in reader.all("html")] == ["en"]
    assert all(len(image["alt"]) > 20 for image in reader.all("img"))
    assert len(reader.all("img")) == 9
    assert all(head["scope"] == "col" and head["aria-sort"] == "none" for head in reader.all("th"))
    assert len(reader.all("button")) == len(reader.all("th"))
    names = [attributes["id"] for _, attributes in reader.elements if "id" in attributes]
    assert len(names) == len(set(names))
    for _, attributes in reader.elements:
        assert attributes.get("aria-labelledby", names[0]) in names
    levels = [int(tag[1]) for tag, _ in reader.elements if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert max(np.diff(levels)) <= 1


def test_verdicts_come_first_and_in_words(found, file):
    result, _ = found
    words = "".join(Reader(file.read_text()).words)
    assert "kf: consistent" in words
    assert f"{EVIL}: inconsistent" in words
    for verdict in result.verdicts.values():
        assert words.index(verdict.headline) < words.index("Figures")
    assert "Not finished" not in words
    assert f"jaxfilt study '{EVIL}'" in words


def test_an_unfinished_study_says_so(found, tmp_path):
    result, _ = found
    page = report.write(result._replace(planned=1000), tmp_path).joinpath("report.html").read_text()
    assert "Not finished: 60 of 1,000 runs were done." in page


def test_numbers_are_written_to_what_is_known_of_them(found):
    result, bound = found
    data = report.summary(result, "walk", bound)
    by_title = {table.title: table for table in tables(data)}
    assert "Runs that went wrong" not in by_title
    place = next(row for row in by_title["Errors"].rows if (row[0].text, row[1].text) == ("kf", "place"))
    rmse = data["filters"]["kf"]["blocks"]["place"]["rmse"]
    value, _, error, unit = place[2].text.split()
    assert unit == "m"
    assert float(value) == pytest.approx(rmse["value"], abs=rmse["error"] / 10)
    assert float(error) == pytest.approx(rmse["error"], rel=0.05)
    assert place[2].order == rmse["value"]
    assert number(None) == Cell("\N{EN DASH}")
    assert number(12345.6, "m").text == "1.235e+4 m"
    assert [card.mood for card in cards(data)] == ["good", "bad"]
    better = {(row[1].text): row[4].text for row in by_title["Filters compared"].rows}
    assert better["log score"] == "kf"


def test_a_study_of_faults_names_run_step_and_sensor(found):
    data = report.summary(found[0])
    kf = data["filters"]["kf"]
    kf["diverged"] = {"runs": 20, "share": 0.3, "first": list(range(3, 19))}
    kf["fault"] = {"run": 3, "step": 7, "sensor": "gnss", "status": "BAD_MEASUREMENT", "runs": 2}
    (table,) = [table for table in tables(data) if table.title == "Runs that went wrong"]
    assert table.rows[0][1].text == "20: run 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, ..."
    assert table.rows[0][2].text == "run 3, step 7, sensor gnss: BAD_MEASUREMENT (faults in 2 runs)"


# --- in a real browser ------------------------------------------------------------------------------------------------

SEEN = """return {
  complaints: 0, width: document.documentElement.scrollWidth, window: window.innerWidth,
  images: [...document.images].map(i => [i.naturalWidth, i.naturalHeight, i.clientWidth]),
  small: [...document.querySelectorAll('body *')].filter(e => e.childElementCount === 0 && e.textContent.trim()
    && parseFloat(getComputedStyle(e).fontSize) < 12).length,
  outside: [...document.querySelectorAll('body *')].filter(e => !e.closest('.scroll') && e.tagName !== 'SCRIPT'
    && e.getBoundingClientRect().right > window.innerWidth + 1).length,
  title: document.title}"""
COLUMN = """const table = [...document.querySelectorAll('table')][arguments[0]];
return [...table.tBodies[0].rows].map(r => r.cells[arguments[1]].dataset)"""
STATE = "return [...document.querySelectorAll('table')][0].tHead.rows[0].cells[arguments[0]].getAttribute('aria-sort')"
CONTRAST = """
const light = c => { const [r, g, b] = c.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255)
    .map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b };
const behind = e => { while (e) { const c = getComputedStyle(e).backgroundColor;
    if (!c.startsWith('rgba(0, 0, 0, 0')) return c; e = e.parentElement } return 'rgb(255, 255, 255)' };
return Math.min(...[...document.querySelectorAll('p, td, th button, h1, h2, h3, dt, dd, strong, figcaption, code')]
  .map(e => { const [a, b] = [light(getComputedStyle(e).color), light(behind(e))];
    return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) }))"""


def opened(record_property, capsys):
    """Whether there is a browser to open the page with; the report says which, and the terminal where there is none."""
    record_property("browser", str(installed()))
    if installed() is None:
        with capsys.disabled():
            print("\nNOT OPENED IN A BROWSER: chromium and chromium-driver are not installed", end=" ")
    return installed() is not None


def test_a_reader_sees_all_figures_and_sorts_tables(file, record_property, capsys):
    """In Chromium, where it is installed; where it is not, what the file alone can tell."""
    reader = Reader(file.read_text())
    assert (len(reader.all("img")), len(reader.all("table"))) == (9, 7)
    if not opened(record_property, capsys):
        return
    with browser() as window:
        for width in (1280, 375):
            window.resize(width)
            window.open(file)
            seen = window.run(SEEN)
            assert window.complaints() == []
            assert seen["title"] == f"{EVIL}: jaxfilt"
            assert seen["width"] <= seen["window"] == width
            assert seen["outside"] == seen["small"] == 0
            assert len(seen["images"]) == 9
            assert all(w > 0 and h > 0 and 300 < shown <= width for w, h, shown in seen["images"])
            assert window.run(CONTRAST) > 4.5
            window.do("goog/cdp/execute", cmd="Emulation.setEmulatedMedia", params=DARK)
            assert window.run(CONTRAST) > 4.5
            window.do("goog/cdp/execute", cmd="Emulation.setEmulatedMedia", params={"features": []})
        window.resize(1280)
        window.open(file)
        window.click("thead th:nth-child(3) button")
        errors = [float(cell["number"]) for cell in window.run(COLUMN, 0, 2)]
        assert errors == sorted(errors)
        assert window.run(STATE, 2) == "ascending"
        window.press(SPACE)  # the button has the focus
        errors = [float(cell["number"]) for cell in window.run(COLUMN, 0, 2)]
        assert errors == sorted(errors, reverse=True)
        assert (window.run(STATE, 2), window.run(STATE, 0)) == ("descending", "none")
        window.press(TAB, SPACE)
        assert window.run(STATE, 3) == "ascending"
        claims = [float(cell["number"]) for cell in window.run(COLUMN, 0, 3)]
        assert claims == sorted(claims)
        assert window.complaints() == []


DARK = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}


def test_what_is_unknown_stays_last(tmp_path, found, record_property, capsys):
    """Both ways round, and names sort as names."""
    result, _ = found
    page = report.write(result, tmp_path).joinpath("report.html")
    unknown = "data-none>\N{EN DASH}</td></tr>"
    page.write_text(re.sub(r"data-number='[^']*'>[^<]*</td></tr>", unknown, page.read_text(), count=1))
    assert page.read_text().count(unknown) == 1
    if not opened(record_property, capsys):
        return
    with browser() as window:
        window.resize(1280)
        window.open(page)
        last = "thead th:nth-child(6) button"
        for _ in range(2):
            window.click(last)
            cells = window.run(COLUMN, 0, 5)
            assert ["none" in cell for cell in cells] == [False] * (len(cells) - 1) + [True]
        window.click("thead th:nth-child(1) button")
        names = [cell["text"] for cell in window.run(COLUMN, 0, 0)]
        assert names == sorted(names, key=str.lower)
