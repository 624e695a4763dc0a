"""Scene files and the files that they name, images, atomic writes."""
