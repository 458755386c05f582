"""The web viewer: a page that shows an object, what was tried on it, and what follows from that.

A client like any other: it asks the service by the SDK and shows the answers with viser, whose page needs no
JavaScript of ours. Every browser tab is a :class:`graspdb_viewer.session.Session` of its own.
"""
