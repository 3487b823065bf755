"""The mould as a CAD model: true curves, named and coloured parts."""
