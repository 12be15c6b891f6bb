"""How results become pages: HTML, tables, pictures, and charts that a reader can zoom."""
