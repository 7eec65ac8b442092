"""Video codecs: `compact`, whose weights ship with the package, and the lossless `identity`."""
