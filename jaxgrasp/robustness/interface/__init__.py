"""What callers give and get: arguments laid side by side, sizes of batches, solutions."""
