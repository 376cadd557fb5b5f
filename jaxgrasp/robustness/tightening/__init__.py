"""Tightening forces, (21) and (22), on friction pyramids: scaled, solved, certified and differentiated."""
