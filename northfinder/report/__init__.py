"""What a record says, as one page for people, as pictures, or as data for programs.

`gather` reads a record once, in memory that does not grow with it; `charts` says what is drawn, `page`, `figures`,
`paper` and `document` draw it: as a self-contained HTML page, as SVG and PNG, as PDF, as JSON and Markdown.
"""
