//! A frame in, an estimate out: the API that other programs embed.
