"""Radio maps of runs: values over grids and meshes, their files and pictures, and the reliability of coverage."""
