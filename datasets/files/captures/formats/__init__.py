"""One file per format of photographs with cameras, with its `FORMAT`; `captures/layouts.py` lists the files."""
