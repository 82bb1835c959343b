"""tensorflow-datasets builders, one module a data set; imported only when used."""
