"""Programs with three unknowns a contact and linear rows, (21) and (22): block-diagonal but for a few borders."""
