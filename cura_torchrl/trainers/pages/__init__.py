"""HTML and Markdown pages, section by section."""
