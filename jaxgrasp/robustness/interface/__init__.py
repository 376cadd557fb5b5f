"""The way in and out: arguments laid side by side, sizes of batches, solutions."""
