"""Fields diffracted by wedges: the uniform theory of diffraction (UTD) on Sionna RT's types."""

from __future__ import annotations

from typing import Any


def diffraction_matrix(material: Any, to_world: Any, k_in: Any, k_out: Any, si: Any, eta: Any, wavenumber: Any) -> Any:
    """Jones matrix of a diffraction, with the arguments of Sionna RT's ``RadioMaterial._diffraction_matrix``.

    With the coefficients D1 to D4 of Kouyoumjian and Pathak and reflection matrices R0 and Rn of both faces it is
    D1 + D2 + R0 D4 + Rn D3, which for perfect conductors is their solution for the field along the edge (R = -1) and
    across it (R = 1). Sionna RT 2.2 has R0 (D4 - D1) + D2 - D3 in its place, whose reflected terms have the wrong sign:
    total fields jump at the boundary of the reflection.

    Args:
        material: ``sionna.rt.RadioMaterial`` of the wedge.
        to_world: rotation from the local frame, z along the normal of the face 0.
        k_in: local directions of the incident rays.
        k_out: local directions of the diffracted rays.
        si: local directions of the edges and normals of the face n in ``dn_du`` and ``dn_dv``, distances from the edge
            to both ends in ``dp_du``.
        eta: complex relative permittivity.
        wavenumber: 1/m.

    Source: Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction" (1974), Proc. IEEE 62(11), eq. 25;
    lossy faces by Luebbers, "Finite conductivity uniform GTD versus knife edge diffraction" (1984), IEEE Trans.
    Antennas Propag. 32(1), with the reflection coefficients of slabs at the angle of incidence.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt import utils

    from ..slabs import slab_coefficients  # Dr.Jit is imported where paths are evaluated

    edge, faces = si.dn_du, (mi.Vector3f(0, 0, 1), si.dn_dv)
    # Angles from the face 0 in the plane across the edge, and the exterior angle n pi.
    n = 2 - utils.wedge_interior_angle(*faces) / dr.pi
    along_face = dr.normalize(dr.cross(faces[0], edge))

    def angle(direction: Any) -> Any:
        from_face = dr.atan2(direction.z, dr.dot(direction, along_face))
        return dr.select(from_face < 0, from_face + dr.two_pi, from_face)

    phi_in, phi_out = angle(-k_in), angle(k_out)
    sine = dr.norm(dr.cross(k_in, edge))
    kl = wavenumber * si.dp_du.x * si.dp_du.y / (si.dp_du.x + si.dp_du.y) * dr.square(sine)
    kind: Any = mi.Complex2f
    factor = -dr.exp(kind(0, -dr.pi / 4)) / (2 * n * dr.sqrt(dr.two_pi * wavenumber) * sine)

    def coefficient(beta: Any, sign: int) -> Any:
        turns = dr.round((beta + sign * dr.pi) / (dr.two_pi * n))
        a = 2 * dr.square(dr.cos(dr.pi * n * turns - beta / 2))
        return factor * utils.cot_times_f_utd((dr.pi + sign * beta) / (2 * n), kl * a, n, kl)

    # Components across the edge, then along it. In these bases a wave that goes straight on has the matrix -1.
    across_in, across_out = dr.normalize(dr.cross(k_in, edge)), -dr.normalize(dr.cross(k_out, edge))
    incident = coefficient(phi_out - phi_in, 1) + coefficient(phi_out - phi_in, -1)
    real, imaginary = (-part * dr.identity(mi.Matrix2f) for part in (incident.real, incident.imag))
    specular = dr.sqrt(1 - dr.square(material.scattering_coefficient))  # amplitude that is not scattered
    for normal, sign in zip(faces, (-1, 1), strict=True):
        cosine = dr.abs(dr.dot(k_in, normal))
        slab = slab_coefficients(cosine, eta, material.thickness * wavenumber)
        share = coefficient(phi_out + phi_in, sign) * specular
        te, tm = slab.reflected_te * share, slab.reflected_tm * share
        # The reflected field has the basis of its own direction, and keeps its components on the way from there to
        # the diffracted ray, as both are in one cone about the edge.
        mirrored = dr.normalize(k_in - 2 * dr.dot(k_in, normal) * normal)
        te_axis = utils.transverse_basis_from_normal(k_in, normal)
        into = utils.jones_matrix_rotator(k_in, across_in, te_axis)
        out = utils.jones_matrix_rotator(mirrored, te_axis, -dr.normalize(dr.cross(mirrored, edge)))
        real += out @ mi.Matrix2f(te.real, 0, 0, tm.real) @ into
        imaginary += out @ mi.Matrix2f(te.imag, 0, 0, tm.imag) @ into
    stated_in, stated_out = (to_world.T @ utils.implicit_basis_vector(to_world @ k) for k in (k_in, k_out))
    into = utils.jones_matrix_rotator(k_in, stated_in, across_in)
    out = utils.jones_matrix_rotator(k_out, across_out, stated_out)
    return utils.jones_matrix_from_real_imag(out @ real @ into, out @ imaginary @ into)
