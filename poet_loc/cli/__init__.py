"""The commands of poet-loc; nobody imports them."""
