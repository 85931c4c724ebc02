"""Who goes: ``strategy`` says who should act (selection), ``lease`` says who may (commitment)."""
