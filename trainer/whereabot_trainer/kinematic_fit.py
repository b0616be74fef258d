"""The kinematic fit: joints moved to the most probable place where an arm can have them.

The joint network says eighteen numbers; an arm's place and posture are eight: where its first joint is, how all is turned about
it, and how far forearm and wrist are bent. What the network says is taken as measured, with the errors that it makes across the line of sight to the
arm (in metres at its mean depth) and along it (in the logarithm of depth), and those eight are fitted to it by four slightly
damped steps of Gauss and Newton. It is what the engine does (`src/reference/kinematic_fit.rs`), which sees it in the model
file as `arm`.
"""

import numpy as np
import torch

STEPS, DAMPING, NEAREST = 4, 0.01, 0.01
LINKS = ("shoulder_offset", "upper_arm", "elbow_offset", "forearm", "wrist_offset", "wrist")
# Of the covariance, the share that is kept of what lies beside its diagonal: a hundred samples know it no better.
TRUST = 0.7
# The share of samples, with the greatest errors, that say nothing of the others' errors.
ASTRAY = 0.1
# Links that differ by less, in metres, are those of one body.
SAME = 0.001


def links_of(joints):
    """The links [N, 6] in metres, in the order of LINKS, of the arms with these `joints` [N, 6, 3]; None unless they are arms of
    that kind: shoulder and wrist offset along one axis, forearm and wrist at a right angle to it."""
    pan, lift, elbow, *wrists = joints.astype(np.float64).transpose(1, 0, 2)
    along, last = lift - pan, wrists[1] - wrists[0]
    axis = along / np.linalg.norm(along, axis=1, keepdims=True)
    upper, forearm, wrist = elbow - lift, wrists[0] - elbow, wrists[2] - wrists[1]

    def on_axis(link):
        return (link * axis).sum(1)

    beside = np.stack([np.linalg.norm(last - on_axis(last)[:, None] * axis, axis=1), on_axis(forearm), on_axis(wrist)])
    if not np.abs(beside).max() < SAME:
        return None
    offset = on_axis(upper)
    return np.stack([
        on_axis(along), np.linalg.norm(upper - offset[:, None] * axis, axis=1), offset, np.linalg.norm(forearm, axis=1),
        on_axis(last), np.linalg.norm(wrist, axis=1)], 1)


def bodies(joints):
    """The different bodies among the arms with these `joints`, as the model file has them; None as `links_of`."""
    links = links_of(joints)
    if links is None:
        return None
    groups = []
    for each in links:
        group = next((group for group in groups if np.abs(group[0] - each).max() < SAME), None)
        if group is None:
            groups.append([each])
        else:
            group.append(each)
    return [dict(zip(LINKS, np.mean(group, 0).round(5).tolist(), strict=True)) for group in groups]


def arm_of(estimates, truths):
    """The model file's `arm`: the bodies among `truths`, and how `estimates` err, both [N, 6, 3] in metres; None as `links_of`."""
    found = bodies(truths)
    if found is None:
        return None
    seen = _view(torch.from_numpy(estimates).double())
    errors = _errors(torch.from_numpy(truths).double(), *seen).numpy()
    return {"bodies": found, "across": _whitening(errors[..., :3], 2), "along": _whitening(errors[..., 3:], 1)}


def _whitening(errors, directions):
    """What makes `errors` [N, 6, D] of the six joints independent and of variance 1 in each of so many directions."""
    size = (errors ** 2 / np.median(errors ** 2, 0).clip(1e-12)).mean((1, 2))
    usual = errors[size <= np.quantile(size, 1 - ASTRAY)]
    covariance = np.einsum("nid,njd->ij", usual, usual) / (len(usual) * directions)
    covariance = TRUST * covariance + (1 - TRUST) * np.diag(np.diag(covariance))
    return np.linalg.cholesky(np.linalg.inv(covariance)).T.round(4).tolist()


def fit(joints, arm):
    """`joints` [N, 6, 3] in metres, in any camera's frame, as the `arm` can have them. Those that are not finite or not in front of
    the camera stay as they are."""
    seen = joints.double()
    possible = _possible(seen)
    fitted = joints.clone()
    if not possible.any():
        return fitted
    seen = seen[possible]
    view = _view(seen)
    whitening = [torch.tensor(arm[part], dtype=torch.float64, device=seen.device) for part in ("across", "along")]
    best, least = seen, seen.new_full((len(seen),), torch.finfo(torch.float32).max)
    for body in arm["bodies"]:
        links = [body[link] for link in LINKS]
        posture = _start(seen, links)
        for _ in range(STEPS):
            place, changes = _joints(posture, links)
            errors = _whitened(_errors(place, *view), whitening).flatten(1)
            columns = _whitened(_change(place, changes, *view[1:]), whitening).flatten(1, 2)
            normal = columns.mT @ columns
            normal = normal + DAMPING * torch.diag_embed(normal.diagonal(dim1=1, dim2=2))
            step, info = torch.linalg.solve_ex(normal, -columns.mT @ errors[..., None])
            posture = _moved(posture, torch.where((info == 0)[:, None], step[..., 0], torch.nan))
        place, _ = _joints(posture, links)
        cost = (_whitened(_errors(place, *view), whitening) ** 2).sum((1, 2))
        better = cost < least
        best, least = torch.where(better[:, None, None], place, best), torch.where(better, cost, least)
    fitted[possible] = best.to(joints.dtype)
    return fitted


def _unit(vector):
    return vector / vector.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def _dot(a, b):
    return (a * b).sum(-1, keepdim=True)


def _possible(joints):
    depths = (joints * _unit(joints.sum(1))[:, None]).sum(-1)
    return ((depths >= NEAREST) & (depths <= 1e6)).all(1)


def _view(seen):
    """(joints, the lines of sight to them [N, 3], their mean depths [N])."""
    sight = _unit(seen.sum(1))
    return seen, sight, (seen * sight[:, None]).sum(-1).mean(1)


def _depths(joints, sight):
    return _dot(joints, sight[:, None]).clamp(min=NEAREST)


def _errors(joints, seen, sight, depth):
    """How far `joints` are from those `seen` [N, 6, 4]: across the line of sight, and along it."""
    depths, seen_depths = _depths(joints, sight), _depths(seen, sight)
    across = depth[:, None, None] * (joints / depths - seen / seen_depths)
    return torch.cat([across, (depths / seen_depths).log()], -1)


def _change(joints, moved, sight, depth):
    """How that changes [N, 6, 4, F] where joints are `moved` [N, 6, 3, F]."""
    depths = _depths(joints, sight)[..., None]
    nearer = (moved * sight[:, None, :, None]).sum(2, keepdim=True) / depths
    across = depth[:, None, None, None] / depths * (moved - nearer * joints[..., None])
    return torch.cat([across, nearer], 2)


def _whitened(errors, whitening):
    across, along = (torch.einsum("ij,nj...->ni...", matrix, part)
                     for matrix, part in zip(whitening, (errors[:, :, :3], errors[:, :, 3:]), strict=True))
    return torch.cat([across, along], 2)


def _start(seen, links):
    """(origin, axis, directions of upper arm, forearm and wrist), each [N, 3], near those `seen`."""
    shoulder_offset, _, elbow_offset, _, wrist_offset, _ = links
    pan, lift, elbow, wrist_1, wrist_2, wrist_3 = seen.unbind(1)
    along = _unit(shoulder_offset * (lift - pan) + wrist_offset * (wrist_2 - wrist_1))
    upper, forearm = elbow - lift - elbow_offset * along, wrist_1 - elbow
    lengths = upper.norm(dim=-1, keepdim=True) * forearm.norm(dim=-1, keepdim=True)
    across = torch.linalg.cross(upper, forearm) / lengths.clamp(min=1e-12)
    across = torch.where(_dot(across, along) < 0, -across, across)
    axis = _unit(along + across)
    level = [_unit(link - _dot(link, axis) * axis) for link in (upper, forearm, wrist_3 - wrist_2)]
    posture = (torch.zeros_like(axis), axis, *level)
    return ((seen - _joints(posture, links)[0]).mean(1), *posture[1:])


def _joints(posture, links):
    """The joints [N, 6, 3] of a posture, and how they move [N, 6, 3, 8] with each of its freedoms."""
    origin, axis, upper, forearm, wrist = posture
    shoulder_offset, upper_arm, elbow_offset, forearm_length, wrist_offset, wrist_length = links
    steps = torch.stack([
        origin, shoulder_offset * axis, upper_arm * upper + elbow_offset * axis, forearm_length * forearm, wrist_offset * axis,
        wrist_length * wrist], 1)
    joints = steps.cumsum(1)
    units = torch.eye(3, dtype=joints.dtype, device=joints.device)
    moved = joints.new_zeros(*joints.shape, 8)
    moved[..., :3] = units
    moved[..., 3:6] = torch.linalg.cross(units.expand(*joints.shape, 3).mT, (joints - origin[:, None])[..., None, :]).mT
    moved[:, 3:, :, 6] = forearm_length * torch.linalg.cross(axis, forearm)[:, None]
    moved[:, 5, :, 7] = wrist_length * torch.linalg.cross(axis, wrist)
    return joints, moved


def _moved(posture, step):
    origin, axis, upper, forearm, wrist = posture
    place, turn, bend_forearm, bend_wrist = step.split([3, 3, 1, 1], 1)
    axis = _turned(axis, turn)
    return (origin + place, axis, _turned(upper, turn), _turned(_turned(forearm, turn), bend_forearm * axis),
            _turned(_turned(wrist, turn), bend_wrist * axis))


def _turned(vector, turn):
    angle = turn.norm(dim=-1, keepdim=True)
    axis = turn / angle.clamp(min=1e-12)
    return vector * angle.cos() + torch.linalg.cross(axis, vector) * angle.sin() + axis * _dot(axis, vector) * (1 - angle.cos())
