"""What users bring: meshes, photographs, depth images, scans, networks. A format is a file."""
