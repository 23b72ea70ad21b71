"""Warp kernels of the roll-out: articulated bodies in reduced coordinates, contact, PD control. Used through `rollout`.

A thread simulates one window from its first step to its last, so a batch of windows is one launch, and Warp's adjoint
of it is the gradient of the whole roll-out. For that an array entry that has been read is not written any more, and
what adds up does so in arrays: Warp does not see variables that change from one turn of a loop to the next.

All vectors are in world axes. A link's state is its orientation and its absolute angular velocity; where it is follows
from its parent, so joints cannot come apart. `n` and `f` are moment about and force at a link's own origin. An
articulated body's inertia (Featherstone 2008, ch. 7) is kept in 3x3 blocks, with a bias of its own:
[n; f] = [[A, G], [G^T, M]] [alpha; a] + bias.

Springs and dampers (joints, contact, assistance) act with the velocities at the end of the step, to first order: a
force f - K a dt with the step's unknown acceleration a adds K dt to the inertia. They cannot blow up.
"""

# Warp's kernel language is Python in syntax only.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false

import warp as wp

from slomo import quiet_warp

quiet_warp.init()


@wp.struct
class BodyStruct:
    """Constants of the body. B links, parents first; C contact points, sorted by link, those of link i from
    `contact_start[i]` to `contact_start[i + 1]`."""

    parent: wp.array(dtype=int)
    offset: wp.array(dtype=wp.vec3)  # of the link's origin in its parent's frame
    com: wp.array(dtype=wp.vec3)
    inertia: wp.array(dtype=wp.mat33)  # about the link's origin, its own frame, at unit mass scale
    mass: wp.array(dtype=float)
    stiffness: wp.array(dtype=float)  # N m / rad of the joint to the parent
    damping: wp.array(dtype=float)  # N m s / rad
    contact_start: wp.array(dtype=int)
    contact_place: wp.array(dtype=wp.vec3)  # in the link's frame
    contact_radius: wp.array(dtype=float)  # height above the ground at which the point touches it
    friction: float
    creep: float  # m/s below which friction is viscous
    round: float  # m over which the contact sets in
    pull: wp.vec4  # of the assistance: N/m, N s/m, N m/rad, N m s/rad


@wp.func
def joint_quaternion(q: wp.vec3) -> wp.quat:
    """Ry Rx Rz of angles (x, y, z), as `kinematics.joint_rotation`."""
    return (
        wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), q[1])
        * wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), q[0])
        * wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), q[2])
    )


@wp.func
def rotation_between(a: wp.quat, b: wp.quat) -> wp.vec3:
    """Rotation vector (rad, near enough below a radian) of b a^-1: from a to b in the frame where both live."""
    d = b * wp.quat_inverse(a)
    s = wp.where(d[3] < 0.0, -2.0, 2.0)
    return wp.vec3(s * d[0], s * d[1], s * d[2])


@wp.func
def turned(q: wp.quat, rotation: wp.vec3) -> wp.quat:
    """q turned by a small rotation vector in the world: the exact exponential to third order, normalised."""
    h = 0.5 * rotation
    c = 1.0 - 0.5 * wp.dot(h, h)
    h = h * (1.0 - wp.dot(h, h) / 6.0)
    return wp.normalize(wp.quat(h[0], h[1], h[2], c) * q)


@wp.kernel
def roll_out(
    body: BodyStruct,
    steps: int,
    dt: float,
    target: wp.array3d(dtype=wp.vec3),
    start_p: wp.array(dtype=wp.vec3),
    start_q: wp.array(dtype=wp.quat),
    start_v: wp.array(dtype=wp.vec3),
    start_w: wp.array(dtype=wp.vec3),
    scale: wp.array2d(dtype=float),
    contact: wp.array(dtype=wp.vec2),
    gravity: wp.array(dtype=float),
    assistance: wp.array(dtype=float),
    guide_p: wp.array2d(dtype=wp.vec3),
    guide_q: wp.array2d(dtype=wp.quat),
    p: wp.array3d(dtype=wp.vec3),
    v: wp.array3d(dtype=wp.vec3),
    q: wp.array3d(dtype=wp.quat),
    w: wp.array3d(dtype=wp.vec3),
    A: wp.array3d(dtype=wp.mat33),
    G: wp.array3d(dtype=wp.mat33),
    M: wp.array3d(dtype=wp.mat33),
    n: wp.array3d(dtype=wp.vec3),
    f: wp.array3d(dtype=wp.vec3),
    D: wp.array3d(dtype=wp.mat33),
    E: wp.array3d(dtype=wp.mat33),
    u: wp.array3d(dtype=wp.vec3),
    alpha: wp.array3d(dtype=wp.vec3),
    a: wp.array3d(dtype=wp.vec3),
    touch: wp.array3d(dtype=wp.vec3),
    grip: wp.array3d(dtype=wp.vec3),
    wrench: wp.array3d(dtype=wp.vec3),
):
    """Window k: joint angles `target` (N, S + 1, B) are tracked from a start on.

    Args:
        start_p, start_q, start_v, start_w: (N,) of the root. scale: (N, B) of the masses. contact: (N,) ke N/m, kd s/m.
        gravity: (N,) m/s^2. assistance: (N,) share of `pull` with which the root follows guide_p, guide_q (N, S + 1).
        p, v, q, w: (N, S + 1, B) states. A, G, M, n, f: (N, S, B), zero before: what a link and all that hangs from it
            oppose to its motion. D, E, u: (N, S, B) of the joints: the link's angular acceleration is
            D (u + soft alpha) - E a with the parent's alpha, and its a at the joint.
        alpha, a: (N, S, B) accelerations. touch, grip: (N, S, C) contact force at the step's beginning, and its
            negative derivatives by the point's velocity, N s/m. wrench: (N, S, 2) assisting force and moment.
    """
    k = wp.tid()
    links = body.parent.shape[0]
    up = wp.vec3(0.0, 0.0, 1.0)
    one = wp.identity(3, dtype=float)

    p[k, 0, 0] = start_p[k]
    q[k, 0, 0] = start_q[k]
    v[k, 0, 0] = start_v[k]
    w[k, 0, 0] = start_w[k]
    for i in range(1, links):
        j = body.parent[i]
        first = joint_quaternion(target[k, 0, i])
        rate = rotation_between(first, joint_quaternion(target[k, 1, i])) / dt
        q[k, 0, i] = q[k, 0, j] * first
        w[k, 0, i] = w[k, 0, j] + wp.quat_rotate(q[k, 0, j], rate)
    for i in range(1, links):
        j = body.parent[i]
        r = wp.quat_rotate(q[k, 0, j], body.offset[i])
        p[k, 0, i] = p[k, 0, j] + r
        v[k, 0, i] = v[k, 0, j] + wp.cross(w[k, 0, j], r)

    for s in range(steps):
        # From the leaves to the root: what each articulated body opposes, seen from its parent.
        for back in range(links):
            i = links - 1 - back
            R = wp.quat_to_matrix(q[k, s, i])
            wi = w[k, s, i]
            m = body.mass[i] * scale[k, i]
            c = R * body.com[i]
            J = R * (body.inertia[i] * scale[k, i]) * wp.transpose(R)
            weight = -m * gravity[k] * up
            A[k, s, i] += J
            G[k, s, i] += m * wp.skew(c)
            M[k, s, i] += m * one
            n[k, s, i] += wp.cross(wi, J * wi) - wp.cross(c, weight)
            f[k, s, i] += m * wp.cross(wi, wp.cross(wi, c)) - weight
            for e in range(body.contact_start[i], body.contact_start[i + 1]):
                x = R * body.contact_place[e]
                depth = body.contact_radius[e] - p[k, s, i][2] - x[2]
                vx = v[k, s, i] + wp.cross(wi, x)
                ke = contact[k][0]
                kd = contact[k][1]
                root = wp.sqrt(depth * depth + body.round * body.round)
                d = 0.5 * (depth + root)
                stiff = ke * (0.5 * (1.0 + depth / root) * dt + kd * d)
                push = wp.max(ke * d - stiff * vx[2], 0.0)
                drag = body.friction * push / wp.sqrt(vx[0] * vx[0] + vx[1] * vx[1] + body.creep * body.creep)
                kz = wp.where(push > 0.0, stiff, 0.0)
                K = wp.diag(wp.vec3(drag * dt, drag * dt, kz * dt))
                force = wp.vec3(-drag * vx[0], -drag * vx[1], push)
                touch[k, s, e] = force
                grip[k, s, e] = wp.vec3(drag, drag, kz)
                force = force - K * wp.cross(wi, wp.cross(wi, x))
                X = wp.skew(x)
                XK = X * K
                A[k, s, i] += XK * wp.transpose(X)
                G[k, s, i] += XK
                M[k, s, i] += K
                n[k, s, i] += -wp.cross(x, force)
                f[k, s, i] += -force
            if i > 0:
                j = body.parent[i]
                Ai = A[k, s, i]
                Gi = G[k, s, i]
                ni = n[k, s, i]
                goal = joint_quaternion(target[k, s + 1, i])
                qj = q[k, s, j]
                behind = rotation_between(goal, wp.quat_inverse(qj) * q[k, s, i])
                rate = rotation_between(joint_quaternion(target[k, s, i]), goal) / dt
                wr = wi - w[k, s, j]
                kp = body.stiffness[i]
                kv = body.damping[i]
                tau = -kp * (wp.quat_rotate(qj, behind) + dt * wr) - kv * (wr - wp.quat_rotate(qj, rate))
                soft = (kp * dt + kv) * dt
                Di = wp.inverse(Ai + soft * one)
                Ei = Di * Gi
                ui = tau - ni
                D[k, s, i] = Di
                E[k, s, i] = Ei
                u[k, s, i] = ui
                r = wp.quat_rotate(qj, body.offset[i])
                X = wp.skew(r)
                # Moved to the parent's origin: its acceleration there is a + alpha x r + w x (w x r).
                turn = wp.cross(w[k, s, j], wp.cross(w[k, s, j], r))
                Mp = M[k, s, i] - wp.transpose(Gi) * Ei
                Gp = soft * Ei
                fp = f[k, s, i] + wp.transpose(Ei) * ui + Mp * turn
                XM = X * Mp
                A[k, s, j] += soft * (Di * Ai) - Gp * X + X * wp.transpose(Gp) - XM * X
                G[k, s, j] += Gp + XM
                M[k, s, j] += Mp
                n[k, s, j] += tau - soft * (Di * ui) + Gp * turn + wp.cross(r, fp)
                f[k, s, j] += fp

        # The root is free but for the assistance.
        help = assistance[k]
        kx = help * body.pull[0]
        cx = help * body.pull[1]
        kr = help * body.pull[2]
        cr = help * body.pull[3]
        v0 = v[k, s, 0]
        w0 = w[k, s, 0]
        ahead = guide_p[k, s + 1]
        spin = rotation_between(guide_q[k, s], guide_q[k, s + 1]) / dt
        F = kx * (ahead - p[k, s, 0] - dt * v0) + cx * ((ahead - guide_p[k, s]) / dt - v0)
        T = kr * (rotation_between(q[k, s, 0], guide_q[k, s + 1]) - dt * w0) + cr * (spin - w0)
        invM = wp.inverse(M[k, s, 0] + (kx * dt + cx) * dt * one)
        Fi = F - f[k, s, 0]
        GM = G[k, s, 0] * invM
        W = A[k, s, 0] + (kr * dt + cr) * dt * one - GM * wp.transpose(G[k, s, 0])
        alpha0 = wp.inverse(W) * (T - n[k, s, 0] - GM * Fi)
        a0 = invM * (Fi - wp.transpose(G[k, s, 0]) * alpha0)
        alpha[k, s, 0] = alpha0
        a[k, s, 0] = a0
        wrench[k, s, 0] = F - (kx * dt + cx) * dt * a0
        wrench[k, s, 1] = T - (kr * dt + cr) * dt * alpha0

        # From the root to the leaves: accelerations, then the state at the end of the step.
        for i in range(1, links):
            j = body.parent[i]
            r = wp.quat_rotate(q[k, s, j], body.offset[i])
            wj = w[k, s, j]
            aj = a[k, s, j] + wp.cross(alpha[k, s, j], r) + wp.cross(wj, wp.cross(wj, r))
            soft = (body.stiffness[i] * dt + body.damping[i]) * dt
            a[k, s, i] = aj
            alpha[k, s, i] = D[k, s, i] * (u[k, s, i] + soft * alpha[k, s, j]) - E[k, s, i] * aj
        for i in range(links):
            next = w[k, s, i] + dt * alpha[k, s, i]
            w[k, s + 1, i] = next
            q[k, s + 1, i] = turned(q[k, s, i], dt * next)
        v[k, s + 1, 0] = v0 + dt * a0
        p[k, s + 1, 0] = p[k, s, 0] + dt * (v0 + dt * a0)
        for i in range(1, links):
            j = body.parent[i]
            r = wp.quat_rotate(q[k, s + 1, j], body.offset[i])
            p[k, s + 1, i] = p[k, s + 1, j] + r
            v[k, s + 1, i] = v[k, s + 1, j] + wp.cross(w[k, s + 1, j], r)


@wp.kernel
def look(
    offset: wp.array(dtype=wp.vec3),
    link: wp.array(dtype=int),
    joints: int,
    step: wp.array2d(dtype=float),
    p: wp.array3d(dtype=wp.vec3),
    q: wp.array3d(dtype=wp.quat),
    nodes: wp.array3d(dtype=wp.vec3),
):
    """Places (N, F, M) of the nodes at moments `step` (N, F), in steps, linearly between two: the first `joints` nodes
    are the origins of the links, the others lie at `offset` in the frame of `link`."""
    k, t, m = wp.tid()
    last = p.shape[1] - 2
    s = wp.min(int(step[k, t]), last)
    part = step[k, t] - float(s)
    x = wp.vec3()
    y = wp.vec3()
    if m < joints:
        x = p[k, s, m]
        y = p[k, s + 1, m]
    else:
        x = p[k, s, link[m]] + wp.quat_rotate(q[k, s, link[m]], offset[m])
        y = p[k, s + 1, link[m]] + wp.quat_rotate(q[k, s + 1, link[m]], offset[m])
    nodes[k, t, m] = x + part * (y - x)
