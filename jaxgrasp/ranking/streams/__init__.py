"""Rankings of any number of candidates: part by part, in bounded memory."""
