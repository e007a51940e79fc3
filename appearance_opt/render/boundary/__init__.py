"""Derivatives of visibility: what moves across pixels although no shaded sample does.

An ``Estimator`` says which camera rays are averaged in the image, and where boundaries pass:
``camera_rays`` with finders such as ``edges`` and ``intersections``, or ``pairs``. Another one is a
module of its own, which ``gradient`` does not name.
"""
