"""Drawings of fibres from elsewhere: curves of SVG and DXF files, and the pad they make."""
