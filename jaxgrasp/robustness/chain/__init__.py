"""The paper's other formulations, (11) to (16), with exact friction cones: built, solved, judged and compared."""
