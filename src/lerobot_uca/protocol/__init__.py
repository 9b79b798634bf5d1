"""The papers' comparison as one command: which cells there are, running them anywhere, tables and figures of them."""
