"""Files: scene files and what they name, images, files that are whole or not there."""
