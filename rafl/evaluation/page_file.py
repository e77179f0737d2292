"""The results page as one HTML file that needs no network: scripts, style and data inside.

The page's modules become one script, whose hash is all that the file's Content-Security-Policy lets run: names in the
data can do nothing, whatever they are.
"""

import base64
import hashlib
import json
import re
from importlib.resources import files

from rafl.evaluation.page_data import PageData, pack_motion

MAX_FRAMES = 300  # of a recording in the file
MAX_BYTES = 12_000_000  # of all motions in the file, as text; further recordings have their errors only
PAGE = "results/results.html"
STYLE = re.compile(r'<link rel="stylesheet" href="/static/([^"]+)">\n')
ICON = re.compile(r'<link rel="icon"[^>]*>\n')
SCRIPT = re.compile(r'<script type="module" src="/static/([^"]+)"></script>\n')
IMPORT = re.compile(r'^import (\* as \w+|\w+|\{[^}]*\}) from "/static/([^"]+)";\n', re.MULTILINE)
EXPORTED = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
LAST_EXPORT = re.compile(r"\bexport ?\{([^{}]*)\};?\s*$")  # of a library
# What would end or change a script element if it stood in one.
UNSAFE = re.compile(r"<(?=!--|/?script)", re.IGNORECASE)


def page_file(data: PageData) -> str:
    """The page with its data in one file.

    Test recordings come first; what goes beyond `MAX_BYTES` is left out, and the page says so.
    """
    text = static_text(PAGE)
    styles = "".join(static_text(name) for name in STYLE.findall(text))
    (entry,) = SCRIPT.findall(text)
    script = _bundle(entry)
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(styles)}'; img-src blob:; "
        "media-src blob:; base-uri 'none'; form-action 'none'"
    )
    head = f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<style>{styles}</style>\n'
    # Before the script, which reads them.
    blocks = [_block("summary", "application/json", _json(data.summary()))]
    blocks += [_block(f"motion-{number}", "text/plain", content) for number, content in _motions(data).items()]
    text = ICON.sub("", STYLE.sub("", SCRIPT.sub("", text)))
    text = text.replace('<meta charset="utf-8">\n', f'<meta charset="utf-8">\n{head}')
    return text.replace("</body>", f'{"".join(blocks)}<script type="module">{script}</script>\n</body>')


def static_text(name: str) -> str:
    """A file of the page."""
    return (files("rafl.evaluation") / "static").joinpath(*name.split("/")).read_text(encoding="utf-8")


def _motions(data: PageData) -> dict[int, str]:
    """Motions as base64 text by number of the recording, as many as the file may hold."""
    order = sorted(range(len(data.recordings)), key=lambda number: data.recordings[number].split != "test")
    found: dict[int, str] = {}
    left = MAX_BYTES
    for number in order:
        content = base64.b64encode(pack_motion(data.recordings[number], MAX_FRAMES)).decode()
        if len(content) > left:
            break
        left -= len(content)
        found[number] = content
    return found


def _json(values: object) -> str:
    """JSON that stands in an element of HTML as it is."""
    return json.dumps(values, separators=(",", ":")).replace("<", "\\u003c")


def _block(name: str, kind: str, content: str) -> str:
    return f'<script type="{kind}" id="{name}">{content}</script>\n'


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _bundle(entry: str) -> str:
    """One script of a module and all that it imports, each in a function that returns its exports.

    Raises:
        ValueError: a module imports or exports in a way that is not understood.
    """
    names: dict[str, str] = {}
    parts: list[str] = []

    def add(module: str) -> str:
        if module not in names:
            body = static_text(module)
            imports = [_import(how, add(other)) for how, other in IMPORT.findall(body)]
            names[module] = f"module{len(names)}"
            parts.append(_wrapped(names[module], module, "".join(imports), IMPORT.sub("", body), module == entry))
        return names[module]

    add(entry)
    return UNSAFE.sub(r"\\x3c", "".join(parts))


def _import(how: str, source: str) -> str:
    if how.startswith("*"):
        return f"const {how.removeprefix('* as ')} = {source};\n"
    if how.startswith("{"):
        return f"const {how.replace(' as ', ': ')} = {source};\n"
    return f"const {how} = {source}.default;\n"


def _wrapped(name: str, module: str, imports: str, body: str, entry: bool) -> str:
    if last := LAST_EXPORT.search(body):
        pairs = [pair.strip().split(" as ") for pair in last[1].split(",")]
        exports = [f"{pair[-1]}: {pair[0]}" for pair in pairs]
        body = body[: last.start()]
    else:
        exports = [f"{own}: {own}" for _, own in EXPORTED.findall(body)]
        body = EXPORTED.sub(r"\1", body)
        if re.search(r"^(import|export)\b", body, re.MULTILINE):
            raise ValueError(f"{module}: expected imports and exports of the forms that a page in one file can hold")
    if entry:  # which may wait at its top level
        return f"{{\n{imports}{body}}}\n"
    return f"const {name} = (() => {{\n{imports}{body}\nreturn {{ {', '.join(exports)} }};\n}})();\n"
