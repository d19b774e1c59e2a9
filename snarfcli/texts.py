"""Texts from files and from users, made safe for the place where they are shown: a message, a terminal or a web page.

A name in a downloaded file can contain anything: control sequences that change a terminal, Markdown or HTML that a page would
run, megabytes. Every such text passes one of these functions on its way out.
"""

from __future__ import annotations

import html
import re

__all__ = ["counted", "html_text", "markdown_text", "one_line", "plain_markdown", "terminal_text"]

_LAYOUT = "\n\t"  # the only control characters that text on a terminal needs
_PLAIN = re.compile(r"[\w .,:;()@+/-]*")  # marks that mean nothing in Markdown, within a line
_MARKS = re.compile(r"[^\w ,]|_")  # everything but letters of any script, digits, spaces and commas


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a number of things: "1 frame", "2 frames"; the plural is the noun with an s unless it is given."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"


def one_line(reason: str | BaseException, longest: int | None = None) -> str:
    """Return a text, or the message of an exception, as one printable line.

    Line breaks and control characters become spaces, and repeated spaces one.

    Args:
        reason: the text or exception; an exception without a message gives the name of its type.
        longest: maximum number of characters; None for no limit. Needed for messages that quote untrusted files.
    """
    text = reason if isinstance(reason, str) else str(reason) or type(reason).__name__
    line = " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())
    return line[:longest]


def terminal_text(text: str) -> str:
    """Return a text whose control characters, except line breaks and tabs, are visible: ESC becomes \\x1b.

    So are the characters that turn the direction of writing, and halves of surrogate pairs, which no terminal can encode.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() or letter in _LAYOUT else ascii(letter)[1:-1] for letter in text)


def markdown_text(text: object, longest: int = 200) -> str:
    """Return a value as one line for Markdown that shows its characters: no mark-up, no links and no HTML works in it.

    Args:
        text: the value.
        longest: maximum number of characters before they are escaped.
    """
    line = one_line(str(text), longest)
    # As numbers of characters: a backslash would not stop MDX, nor keep an address from becoming a link.
    return _MARKS.sub(lambda mark: f"&#{ord(mark[0])};", line)


def plain_markdown(text: str, longest: int = 500) -> str:
    """Return a text as one line for Markdown: as it is if nothing in it is mark-up, else as `markdown_text` does."""
    line = one_line(text, longest)
    return line if _PLAIN.fullmatch(line) else markdown_text(line, longest)


def html_text(text: object, longest: int = 200) -> str:
    """Return a value as one line for HTML, inside an element or a quoted attribute, that shows its characters.

    Args:
        text: the value.
        longest: maximum number of characters before they are escaped.
    """
    return html.escape(one_line(str(text), longest))
