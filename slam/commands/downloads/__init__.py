"""Public data sets from their official servers, only the parts that are wanted."""
