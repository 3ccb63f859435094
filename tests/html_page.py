"""Parser of HTML pages for tests: elements, text, links."""

from html.parser import HTMLParser

from spelgen.templates import SCRIPTS, read

OWN = {read(name).strip() for name in SCRIPTS}
VOID = {"meta", "br", "link", "input"}


class Page(HTMLParser):
    """Elements, text and links of an HTML page; asserts that tags are nested and all scripts are the package's own."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.data = False
        self.open, self.tags, self.text = [], [], []
        self.links, self.scripts = [], []
        self.feed(text)
        assert not self.open
        # only the package's own scripts run; <script> elements of JSON data are not in `scripts`
        assert set(self.scripts) <= OWN

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "action", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)
        self.data = tag == "script" and dict(attrs).get("type") == "application/json"

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script" and not self.data:
            self.scripts.append(data)
        elif self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)
