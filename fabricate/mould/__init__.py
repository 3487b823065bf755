"""The mould, from the plan to solids and meshes."""
