"""Draft of a robot file from the files of vendors, or from the nodes of a bus."""
