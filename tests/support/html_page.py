"""A parsed HTML page."""

from html.parser import HTMLParser

VOID = {"meta", "link", "img", "source", "br", "input"}
REFERRING = ("src", "srcset", "href", "data", "action", "poster", "background", "style")


class HtmlPage(HTMLParser):
    """Tags, references and texts by element; elements must nest."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.source, self.references, self.tags, self._open = source, [], [], []
        self.texts: dict[str | None, str] = {}  # by the identifier or tag of what came before
        self._before, self._words = None, []
        self.feed(source)
        self.close()
        assert self._open == []
        self.text = " ".join(" ".join(self._words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.references += [value for name, value in attrs if name in REFERRING]
        self._before = dict(attrs).get("id", tag)
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self._words.append(data)
        self.texts[self._before] = self.texts.get(self._before, "") + data
