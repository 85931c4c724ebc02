"""The Sony AIBO ERS-7 as Tekkotsu serves it: codecs, options, links and driver."""
