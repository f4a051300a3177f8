"""Web pages in one style, light and dark, in which pictures can be enlarged, and tables sorted and copied.

A page needs no other files than its pictures, and can be read without JavaScript.
"""

import html
import re
from collections.abc import Mapping, Sequence

CSS = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1d2329; --soft: #5b6670; --line: #e2e6ea; --tint: #f6f8fa;
  --link: #174ea6; --good: #1a7f37; --bad: #b42318; --note: #fff7e6; }
@media (prefers-color-scheme: dark) { :root { --paper: #15191d; --ink: #e4e8ec; --soft: #a3adb7; --line: #333b43;
  --tint: #1f252b; --link: #8ab4f8; --good: #57c278; --bad: #ff8a7a; --note: #3a2f16; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI",
  Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 60rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1, h2, p, li, figcaption { overflow-wrap: anywhere; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.1rem; margin: 2.75rem 0 .6rem; padding-top: .9rem; border-top: 1px solid var(--line); }
p { margin: .4rem 0; } .soft, figcaption, caption { color: var(--soft); }
code, pre { font: .86rem/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace;
  background: var(--tint); border-radius: 4px; }
code { padding: .1rem .3rem; overflow-wrap: anywhere; }
pre { padding: .8rem 1rem; overflow: auto; max-height: 30rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .86rem; font-variant-numeric: tabular-nums; }
caption { caption-side: bottom; text-align: left; padding-top: .5rem; font-size: .86rem;
  position: sticky; left: 0; max-width: calc(100vw - 3.5rem); } /* read whole where its table is scrolled */
th, td { padding: .32rem .45rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; white-space: normal; }
thead th { white-space: normal; vertical-align: bottom; font-weight: 600; border-bottom: 1px solid var(--line); }
thead tr:last-child th { border-bottom: 2px solid var(--ink); font-weight: 400; color: var(--soft); }
tbody tr { border-bottom: 1px solid var(--line); } td.first, th.first { padding-left: 1.2rem; }
i.swatch { display: inline-block; width: .75rem; height: .75rem; border-radius: 2px; margin-right: .5rem; }
figure { margin: 0; } figure img { display: block; max-width: 100%; height: auto; margin: .5rem 0;
  background: #fff; cursor: zoom-in; }
dialog { max-width: 98vw; max-height: 96vh; padding: 0; border: 0; background: #fff; cursor: zoom-out; }
figcaption { font-size: .9rem; max-width: 46rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.2rem; margin: 1rem 0 0;
  font-size: .92rem; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
thead th[tabindex] { cursor: pointer; }
button { font: inherit; font-size: .8rem; color: var(--link); background: none; border: 1px solid var(--line);
  border-radius: 4px; margin: .4rem 0; padding: .1rem .5rem; cursor: pointer; }
summary { cursor: pointer; }
ul.verdicts { margin: .3rem 0 1rem; padding-left: 1.2rem; } ul.verdicts li { margin: .15rem 0; }
.good { color: var(--good); } .bad { color: var(--bad); }
.note { background: var(--note); border-left: 3px solid #f5a025; padding: .5rem .9rem; }
nav a { color: var(--link); display: inline-block; margin-right: .9rem; text-decoration: none; font-size: .92rem; }
@media (max-width: 30rem) { dl { grid-template-columns: minmax(0, 1fr); } main { padding: 1.25rem .9rem 3rem; } }
@media print { main { max-width: none; padding: 0; } h2 { break-after: avoid; }
  figure { break-inside: avoid; }
  details, nav, button { display: none; } }
"""

SCRIPT = """
const large = document.body.appendChild(document.createElement("dialog"));
large.onclick = () => large.close();
const pressed = (element, act) => {
  element.tabIndex = 0;
  element.onclick = act;
  element.onkeydown = (event) => event.key === "Enter" && act();
};
for (const image of document.querySelectorAll("figure img")) {
  image.title = "Enlarge";
  pressed(image, () => {
    const copy = document.createElement("img");
    copy.src = image.src;
    copy.alt = image.alt;
    large.replaceChildren(copy);
    large.showModal();
  });
}
const number = (text) => parseFloat(text.replace("\u2212", "-").replace(/^[^0-9.-]+/, ""));
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0];
  [...(table.tHead?.rows[table.tHead.rows.length - 1]?.cells ?? [])].forEach((heading, column) => {
    let sign = -1;
    heading.title = "Sort";
    pressed(heading, () => {
      sign = -sign;
      const text = (row) => row.cells[column].innerText.trim();
      const compare = (one, other) => {
        const [a, b] = [number(text(one)), number(text(other))];
        if (isNaN(a) || isNaN(b)) return isNaN(a) - isNaN(b) || sign * text(one).localeCompare(text(other));
        return sign * (a - b);
      };
      body.append(...[...body.rows].sort(compare));
      for (const other of heading.parentElement.cells) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    });
  });
  const copy = document.createElement("button");
  copy.textContent = "Copy table";
  copy.onclick = () => {
    getSelection().selectAllChildren(table);
    document.execCommand("copy"); // the newer way is refused on pages that are opened as files
    getSelection().removeAllRanges();
    copy.textContent = "Copied";
  };
  table.closest(".wide")?.after(copy);
}
"""


def document(title: str, parts: Sequence[str]) -> str:
    r"""A whole page in HTML.

    Args:
        title: title in plain text.
        parts: parts of the page in HTML.

    Example:
        >>> "<h1>&lt;1&gt;</h1>\n<p>Less.</p>" in document("<1>", ["<p>Less.</p>"])
        True
    """
    every = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{CSS}</style></head><body><main>",
        f"<h1>{html.escape(title)}</h1>",
        *parts,
        f"</main><script>{SCRIPT}</script></body></html>",
    ]
    return "\n".join(every) + "\n"


def prose(text: str) -> str:
    """Plain text in HTML, with text between backticks as code.

    Example:
        >>> prose("`jaxlfi report` if x < 1")
        '<code>jaxlfi report</code> if x &lt; 1'
    """
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


def figure(source: str, alternative: str, caption: str, width: int | None = None) -> str:
    """A picture with its caption.

    Args:
        source: address of the picture.
        alternative: description for those who cannot see it.
        caption: text below it.
        width: width in pixels, at most that of the window; by default the picture's own.
    """
    size = f' width="{width}"' if width else ""
    return (
        f'<figure><img{size} alt="{html.escape(alternative)}" src="{html.escape(source)}">'
        f"<figcaption>{prose(caption)}</figcaption></figure>"
    )


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """A table of rows, all with the headings of the first one."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in rows[0])
    lines = ("".join(f"<td>{html.escape(value)}</td>" for value in row.values()) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return wide(f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>")


def wide(table: str) -> str:
    """A table that is scrolled if it is wider than the window."""
    return f'<div class="wide" tabindex="0">{table}</div>'
