"""The attacks S1 to S12, a module each: what an outsider, a bad member or a thief may try, and what stops it."""
