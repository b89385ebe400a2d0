"""Files: one format a file, read_x and write_x; units and quaternion order change here and nowhere else."""
