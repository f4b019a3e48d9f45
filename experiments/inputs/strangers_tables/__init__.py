"""Tables as strangers have them, drawn with a known truth, and what `import` makes of them."""
