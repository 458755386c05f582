"""Files of any size as streams: events of JSON and YAML, columns of numbers, elements of XML."""
