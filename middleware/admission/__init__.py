"""Admission: who belongs to a closed team, how one comes into it, and how one is put out of it again."""
