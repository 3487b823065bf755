"""Elements of pages: Markdown becomes them, and text stays text."""

import re

from design.common.page.elements import PageSection, html_pieces, page, table


def test_markdown_becomes_headings_lists_tables_and_paragraphs():
    rows = "| a | b |\n| --- | --- |\n| 1.5 mm | fail |"
    steps = "1. Stir **well**.\n2. Read `x.json`."
    head, rows, steps, end = html_pieces(f"# Title\n\n## Mix\n\n{rows}\n\n{steps}\n\nDone.")
    assert head == "<h3>Mix</h3>"
    assert rows == table(["a", "b"], [["1.5 mm", "fail"]])
    assert '<td class="number">1.5 mm</td><td class="fail">fail</td>' in rows
    assert re.sub(r"\s", "", steps) == ("<ol><li>Stir<strong>well</strong>.</li><li>Read<code>x.json</code>.</li></ol>")
    assert end.strip() == "<p>Done.</p>"


def test_html_and_links_in_markdown_are_text():
    (piece,) = html_pieces('<img src="x"> [a](javascript:b) ![c](http://d) &lt;')
    assert piece.strip() == "<p>&lt;img src=&quot;x&quot;&gt; [a](javascript:b) ![c](http://d) &amp;lt;</p>"


def test_sections_are_linked_and_their_text_is_escaped():
    text = page("<b>", "&", [PageSection("A <i> b", [table(["<u>"], [["<s>"]])], [("<1>", "<2>")])])
    assert not re.search("<[ius12]>", text)
    assert "<title>&lt;b&gt;</title>" in text
    assert '<a href="#a-i-b">A &lt;i&gt; b</a>' in text
    assert '<h2 id="a-i-b">A &lt;i&gt; b</h2>' in text
    assert '<div class="tile"><b>&lt;1&gt;</b> &lt;2&gt;</div>' in text
