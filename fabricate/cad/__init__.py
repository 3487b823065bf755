"""CAD model of the mould: exact curves, named and coloured solids, STEP."""
