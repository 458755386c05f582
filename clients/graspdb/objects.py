"""Objects: their mesh and convex parts, and every question that can be asked about grasping them."""

from __future__ import annotations

import builtins
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from graspdb import wire
from graspdb.errors import GraspDBError, Infeasible
from graspdb.meshes import GLB, MeshLike, read_mesh, scene_of
from graspdb.pages import Listing, checked, segment
from graspdb.poses import as_poses, as_vector7
from graspdb.reports import Reports
from graspdb.results import Grasp, Grasps, LikelihoodArrays, SampledPoses, table_html
from graspdb.sweeps import Sweep, Sweeps, create_sweep
from graspdb.transport import Transport
from graspdb.trials import Batches, Trials

__all__ = ["GraspObject", "Objects"]

Kernel = wire.KernelSpec | Mapping[str, Any] | str

QUERY_POSES = 100_000
"""Poses a likelihood request: some 15 MB of JSON, well under the service's default body limit."""


class GraspObject:
    """An object on the service.

    ``info`` is what the service said last; :meth:`refresh` asks again. ``trials`` and ``batches`` hold what
    has been tried, the methods ask what follows from it, and ``reports`` whether that was enough. All poses
    are of the tool frame in the object frame, in metres, quaternions xyzw.

    Queries take the *selection* of trials a density is built from: ``gripper``, ``protocol``, ``source``,
    and the ``kernel`` (``"isotropic"`` or its widths ``sigma_position_m``, ``sigma_rotation_deg``).
    """

    def __init__(self, transport: Transport, info: wire.ObjectInfo) -> None:
        self._transport = transport
        self._path = f"/objects/{segment(info.id)}"
        self.info = info
        self.trials = Trials(transport, info.id)
        self.batches = Batches(transport, info.id)
        self.reports = Reports(transport, self._path)

    @property
    def id(self) -> str:
        """The object's identifier."""
        return self.info.id

    def refresh(self) -> GraspObject:
        """Ask the service for its present state."""
        return self._update(self._transport.json("GET", self._path))

    def patch(self, /, **changes: Any) -> GraspObject:
        """Change ``name``, ``mass_kg``, ``density_kg_m3``, ``friction`` or ``metadata``; None clears."""
        answer = self._transport.json("PATCH", self._path, body=_patch(changes))
        return self._update(answer)

    def delete(self) -> None:
        """Delete the object with everything that belongs to it."""
        self._transport.request("DELETE", self._path)

    def _update(self, answer: Any) -> GraspObject:
        self.info = wire.ObjectInfo.model_validate(answer)
        return self

    # Mesh and convex parts

    def upload_mesh(self, mesh: MeshLike, *, unit: str = "m", media_type: str | None = None) -> wire.MeshInfo:
        """Store the object's mesh.

        Parameters
        ----------
        mesh
            A file (.stl, .obj, .ply, .glb), its bytes, or a trimesh object.
        unit
            Of its coordinates: ``m``, ``mm``, ``cm`` or ``in``.
        media_type
            Needed for bytes whose format they do not tell themselves.
        """
        content, kind = read_mesh(mesh, media_type)
        answer = self._transport.json(
            "PUT",
            f"{self._path}/mesh",
            params={"unit": unit},
            content=content,
            headers={"Content-Type": kind},
        )
        info = wire.MeshInfo.model_validate(answer)
        self.refresh()
        return info

    def download_mesh(self) -> bytes:
        """The mesh as it was uploaded."""
        return self._transport.request("GET", f"{self._path}/mesh").content

    def upload_convex_parts(self, parts: MeshLike | Sequence[Any]) -> wire.PartsInfo:
        """Store the convex parts the object is made of, in metres.

        Parameters
        ----------
        parts
            A GLB file or its bytes with one geometry a part, a trimesh scene, or a sequence of meshes.
        """
        if isinstance(parts, Sequence) and not isinstance(parts, (str, bytes)):
            parts = scene_of(parts)
        content, kind = read_mesh(parts, None, prefer="glb")
        if kind != GLB:
            raise ValueError(f"convex parts come as GLB, one geometry a part; this is {kind}")
        answer = self._transport.json(
            "PUT", f"{self._path}/convex-parts", content=content, headers={"Content-Type": GLB}
        )
        info = wire.PartsInfo.model_validate(answer)
        self.refresh()
        return info

    def download_convex_parts(self) -> bytes:
        """The convex parts as GLB."""
        return self._transport.request("GET", f"{self._path}/convex-parts").content

    # Questions

    def density(
        self,
        *,
        gripper: str | None = None,
        protocol: str | None = None,
        source: str | None = None,
        kernel: str | None = None,
        sigma_position_m: float | None = None,
        sigma_rotation_deg: float | None = None,
    ) -> wire.DensityInfo:
        """The grasp density: kernel, widths and how they were chosen, counts, effective sample size."""
        params = {
            "gripper": gripper,
            "protocol": protocol,
            "source": source,
            "kernel": kernel,
            "sigma_position_m": sigma_position_m,
            "sigma_rotation_deg": sigma_rotation_deg,
        }
        return wire.DensityInfo.model_validate(
            self._transport.json("GET", f"{self._path}/density", params=params)
        )

    def likelihood(
        self,
        poses: ArrayLike | Any,
        *,
        include: Sequence[str] | None = None,
        gripper: str | None = None,
        protocol: str | None = None,
        source: str | None = None,
        kernel: Kernel | None = None,
        sigma_position_m: float | None = None,
        sigma_rotation_deg: float | None = None,
        chunk: int = QUERY_POSES,
    ) -> LikelihoodArrays:
        """How likely these grasps are, as NumPy arrays in the poses' order.

        Parameters
        ----------
        poses
            (N, 4, 4), (N, 7) rows x y z qx qy qz qw, one pose, a grasp or samples.
        include
            Columns to compute: ``density``, ``log_density``, ``relative``, ``success_probability``,
            ``interval``, ``effective_trials``, ``collision_free``; by default all.
        chunk
            Poses a request.
        """
        position, quaternion = as_poses(poses)
        options = {
            "include": None
            if include is None
            else [include]
            if isinstance(include, str)
            else builtins.list(include),
            "gripper": gripper,
            "protocol": protocol,
            "source": source,
            "kernel": kernel,
            "sigma_position_m": sigma_position_m,
            "sigma_rotation_deg": sigma_rotation_deg,
        }
        # Checked once with a single pose: the arrays are checked already, and a model of a million is slow.
        probe = {"position": position[:1].tolist(), "quaternion_xyzw": quaternion[:1].tolist()}
        request = checked(wire.LikelihoodRequest, {**options, "poses": probe}).model_dump(
            mode="json", exclude_unset=True
        )
        answers: list[wire.Likelihoods] = []
        for attempt in range(3):
            answers = []
            for start in range(0, len(position), chunk):
                part = slice(start, start + chunk)
                columns = {"position": position[part].tolist(), "quaternion_xyzw": quaternion[part].tolist()}
                answer = self._transport.json(
                    "POST", f"{self._path}/likelihood", body={**request, "poses": columns}
                )
                answers.append(wire.Likelihoods.model_validate(answer))
                if answers[-1].revision != answers[0].revision and attempt < 2:
                    break  # new trials came in between: one answer must rest on one revision
            else:
                break
        return LikelihoodArrays.from_wire(answers)

    def best_grasp(self, /, **constraints: Any) -> Grasp:
        """The best grasp within constraints; those of :meth:`best_grasps`, without ``count``.

        Raises
        ------
        Infeasible
            If no admissible grasp lies within reach of what was tried, or nothing has succeeded yet.
        """
        if "count" in constraints:
            raise TypeError("best_grasp() gives one grasp; use best_grasps(count=...)")
        return self.best_grasps(count=1, **constraints)[0]

    def best_grasps(
        self,
        *,
        count: int = 5,
        objective: str | None = None,
        robust_of: str | None = None,
        pose_noise_m: float | None = None,
        pose_noise_deg: float | None = None,
        tool_noise_m: float | None = None,
        tool_noise_deg: float | None = None,
        box: tuple[ArrayLike, ArrayLike] | None = None,
        sphere: ArrayLike | None = None,
        above_plane: ArrayLike | None = None,
        half_spaces: ArrayLike | None = None,
        approach: ArrayLike | None = None,
        approach_cone_deg: float | None = None,
        closing: ArrayLike | None = None,
        closing_cone_deg: float | None = None,
        collision_free: bool | None = None,
        obstacles: wire.Obstacles | Mapping[str, Any] | None = None,
        pregrasp_distance_m: float | None = None,
        max_width_m: float | None = None,
        candidates: ArrayLike | Any | None = None,
        exclude: ArrayLike | Any | None = None,
        object_pose: ArrayLike | Any | None = None,
        frame: str | None = None,
        include: Sequence[str] | None = None,
        min_separation_m: float | None = None,
        min_separation_deg: float | None = None,
        gripper: str | None = None,
        protocol: str | None = None,
        source: str | None = None,
        kernel: Kernel | None = None,
        sigma_position_m: float | None = None,
        sigma_rotation_deg: float | None = None,
        verify: bool = False,
        verify_timeout_s: float = 300.0,
    ) -> Grasps:
        """At most ``count`` distinct grasps, best first.

        All constraints are in ``frame``: the world's if ``object_pose`` is given, else the object's.

        Parameters
        ----------
        objective
            ``density`` (the default), ``success_probability`` (ranks by the lower end of its interval), or
            ``robust``: the mean success probability, or density (``robust_of``), under noise.
        pose_noise_m, pose_noise_deg, tool_noise_m, tool_noise_deg
            That noise, deviations per axis: of the object's pose about its bounding box's centre (acts on the
            left), and of the tool's (acts on the right).
        box
            Lower and upper corner (3,) of where the tool's origin may be, metres.
        sphere
            ``x, y, z, r``: the tool's origin is within ``r`` metres of the centre.
        above_plane
            ``nx, ny, nz, d``: n.x >= d at the tool's origin.
        half_spaces
            More such rows (K, 4).
        approach, approach_cone_deg
            Direction (3,) of the tool's z axis, and the half angle of the cone about it.
        closing, closing_cone_deg
            The same for the tool's y axis, in which the fingers close.
        collision_free
            That the gripper does not touch the object before it closes; true where it can be known.
        obstacles
            ``boxes`` (each ``size_m`` and a pose), ``points`` (K, 3) and their ``point_radius_m``: what the
            open gripper must not touch either.
        pregrasp_distance_m
            The straight approach is free from this far back.
        max_width_m
            How far apart the fingers are at most, once both touch the object.
        candidates
            Rank these poses, (N, 4, 4) or (N, 7), as they are; ``grasp.candidate`` is the place in them.
        exclude
            Poses to stay away from, by the separation.
        object_pose
            The object in the world: (4, 4) or ``x y z qx qy qz qw``.
        min_separation_m, min_separation_deg
            How far apart two grasps are, in either, to count as distinct.
        include
            Scores to compute, as in :meth:`likelihood`. By default the success probability comes along where
            the objective needs it or there are at most 500,000 attempts.
        verify
            Have a worker simulate the grasps at the fine step before they are answered: ``grasp.simulated``
            is what became of each, and those that held come first. The outcomes are stored as a check. With
            the gripper and protocol of the trials, where they say; else ``pg70`` and ``wrench``.
        verify_timeout_s
            How long to wait for that.

        Raises
        ------
        Infeasible
            If there is none; ``nearest`` is the closest grasp outside the constraints, where there is one.
        TimeoutError
            If the simulation has not finished in time; it says so where no worker has come.
        """
        fields: dict[str, Any] = {
            "count": count,
            "objective": objective,
            "robust_of": robust_of,
            "pose_noise_m": pose_noise_m,
            "pose_noise_deg": pose_noise_deg,
            "tool_noise_m": tool_noise_m,
            "tool_noise_deg": tool_noise_deg,
            "half_spaces": _rows("half_spaces", half_spaces, 4, "nx, ny, nz, d"),
            "obstacles": _obstacles(obstacles),
            "pregrasp_distance_m": pregrasp_distance_m,
            "max_width_m": max_width_m,
            "candidates": _pose_columns(candidates),
            "exclude": _pose_columns(exclude),
            "include": None if include is None else builtins.list(include),
            "sphere": _numbers("sphere", sphere, 4, "x, y, z, r"),
            "above_plane": _numbers("above_plane", above_plane, 4, "nx, ny, nz, d"),
            "approach": _numbers("approach", approach, 3, "x, y, z"),
            "approach_cone_deg": approach_cone_deg,
            "closing": _numbers("closing", closing, 3, "x, y, z"),
            "closing_cone_deg": closing_cone_deg,
            "collision_free": collision_free,
            "object_pose": None if object_pose is None else as_vector7(object_pose),
            "frame": frame,
            "min_separation_m": min_separation_m,
            "min_separation_deg": min_separation_deg,
            "gripper": gripper,
            "protocol": protocol,
            "source": source,
            "kernel": kernel,
            "sigma_position_m": sigma_position_m,
            "sigma_rotation_deg": sigma_rotation_deg,
        }
        if box is not None:
            if len(box) != 2:
                raise ValueError("box is a pair: its lower and its upper corner, each x, y, z")
            fields["box_min"] = _numbers("box's lower corner", box[0], 3, "x, y, z")
            fields["box_max"] = _numbers("box's upper corner", box[1], 3, "x, y, z")
        request = checked(wire.BestGraspRequest, fields)
        answer = self._transport.json("POST", f"{self._path}/best-grasp", body=request)
        grasps = Grasps(wire.BestGrasps.model_validate(answer))
        if len(grasps):
            if not verify:
                return grasps
            return self._simulated(grasps, gripper, protocol, source, verify_timeout_s)
        if grasps.status == "no_successes":
            raise Infeasible(f"{self.id} has no successful trial yet, so there is no grasp to choose from")
        where = "" if grasps.nearest is None else f"; the nearest grasp outside is {grasps.nearest!r}"
        raise Infeasible(
            f"no grasp of {self.id} fulfils the constraints within reach of what was tried{where}",
            nearest=grasps.nearest,
        )

    def _simulated(
        self,
        grasps: Grasps,
        gripper: str | None,
        protocol: str | None,
        source: str | None,
        timeout_s: float,
    ) -> Grasps:
        """The grasps with their outcomes in simulation, by the gripper and protocol of their trials."""
        chosen = self.density(gripper=gripper, protocol=protocol, source=source)
        sweep = self.sweep(
            poses=grasps.matrices,
            gripper=chosen.gripper,
            protocol=chosen.protocol if chosen.protocol in get_args(wire.sweeps.Protocol) else None,
            fidelity="fine",
            purpose="check",
        )
        try:
            sweep.wait(timeout=timeout_s)
        except TimeoutError as error:
            hint = sweep.hint()
            raise TimeoutError(f"{error}{'' if hint is None else f': {hint}'}") from None
        outcomes = sweep.outcomes()
        return grasps.simulated(outcomes.outcome[np.argsort(outcomes.pose_index)].tolist())

    def samples(
        self,
        count: int = 100,
        *,
        seed: int | None = None,
        gripper: str | None = None,
        protocol: str | None = None,
        source: str | None = None,
        kernel: Kernel | None = None,
        sigma_position_m: float | None = None,
        sigma_rotation_deg: float | None = None,
    ) -> SampledPoses:
        """Poses drawn from the density; the same seed and revision give the same poses."""
        fields = {
            "count": count,
            "seed": seed,
            "gripper": gripper,
            "protocol": protocol,
            "source": source,
            "kernel": kernel,
            "sigma_position_m": sigma_position_m,
            "sigma_rotation_deg": sigma_rotation_deg,
        }
        request = checked(wire.SamplesRequest, fields)
        answer = self._transport.json("POST", f"{self._path}/samples", body=request)
        return SampledPoses.from_wire(wire.Samples.model_validate(answer))

    def proposals(
        self,
        count: int = 100,
        *,
        strategy: str = "density",
        seed: int | None = None,
        gripper: str | None = None,
        protocol: str | None = None,
        source: str | None = None,
        kernel: Kernel | None = None,
        sigma_position_m: float | None = None,
        sigma_rotation_deg: float | None = None,
    ) -> SampledPoses:
        """Grasps to try next; send ``proposal_density`` back with their trials.

        Parameters
        ----------
        strategy
            ``density`` draws where successes lie, ``uncertainty`` where one more trial teaches most.
        """
        fields = {
            "count": count,
            "seed": seed,
            "strategy": strategy,
            "gripper": gripper,
            "protocol": protocol,
            "source": source,
            "kernel": kernel,
            "sigma_position_m": sigma_position_m,
            "sigma_rotation_deg": sigma_rotation_deg,
        }
        request = checked(wire.ProposalsRequest, fields)
        answer = self._transport.json("POST", f"{self._path}/proposals", body=request)
        return SampledPoses.from_wire(wire.Proposals.model_validate(answer))

    def sweep(
        self,
        *,
        max_poses: int | None = None,
        position_step_m: float | None = None,
        rotation_step_deg: float | None = None,
        margin_m: float | None = None,
        region: tuple[ArrayLike, ArrayLike] | None = None,
        seed: int | None = None,
        poses: ArrayLike | Any | None = None,
        sample: int | None = None,
        gripper: str | None = None,
        protocol: str | None = None,
        fidelity: str | None = None,
        purpose: str | None = None,
        chunk_poses: int | None = None,
    ) -> Sweep:
        """Have workers simulate grasps: over a grid (the default), given ``poses``, or ``sample`` draws.

        Parameters
        ----------
        max_poses
            A random part of the grid, by ``seed``; without it the whole grid.
        position_step_m, rotation_step_deg, margin_m, region
            The grid: its steps, its margin about the bounding box, and the box (lower, upper) it is cut to.
        poses
            Exactly these.
        sample
            So many draws from the density.
        gripper
            Its profile's id, by default ``pg70``.
        protocol
            ``wrench`` (the contact forces can counter gravity in every direction) or ``lift``.
        fidelity
            ``standard`` or ``fine`` (smaller time step).
        purpose
            ``collect``, or ``check``: outcomes are stored but enter no density.
        """
        grid = {
            "max_poses": max_poses,
            "position_step_m": position_step_m,
            "rotation_step_deg": rotation_step_deg,
            "margin_m": margin_m,
        }
        if region is not None:
            grid["region"] = {  # type: ignore[assignment]
                "lower": _numbers("region's lower corner", region[0], 3, "x, y, z"),
                "upper": _numbers("region's upper corner", region[1], 3, "x, y, z"),
            }
        grid = {key: value for key, value in grid.items() if value is not None}
        if (poses is not None) + (sample is not None) + bool(grid) > 1:
            raise ValueError(
                f"give grid options ({', '.join(grid) or 'none'}), poses or sample, one of the three"
            )
        if poses is not None and seed is not None:
            raise ValueError("seed is for a grid or for sample: given poses are simulated as they are")
        drawn = None
        if sample is not None:
            drawn = {"count": sample} | ({} if seed is None else {"seed": seed})
        elif poses is None:
            grid |= {} if seed is None else {"seed": seed}
        return create_sweep(
            self._transport,
            self.id,
            grid=grid if poses is None and sample is None else None,
            poses=poses,
            sample=drawn,
            gripper=gripper,
            protocol=protocol,
            fidelity=fidelity,
            purpose=purpose,
            chunk_poses=chunk_poses,
        )

    def sweeps(self) -> Iterator[Sweep]:
        """The sweeps of this object."""
        return Sweeps(self._transport).list(object=self.id)

    def summary(self) -> dict[str, str]:
        """What a person wants to know of it, in words."""
        info = self.info
        rows = {"object": info.id}
        if info.name:
            rows["name"] = info.name
        for label, value, unit in (
            ("mass", info.mass_kg, "kg"),
            ("density", info.density_kg_m3, "kg/m³"),
            ("friction", info.friction, ""),
        ):
            if value is not None:
                rows[label] = f"{value:g} {unit}".rstrip()
        if info.mesh is not None:
            size = np.subtract(info.mesh.bounding_box.upper, info.mesh.bounding_box.lower) * 1000
            rows["mesh"] = (
                f"{size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm, {info.mesh.faces:,} triangles, "
                + ("watertight" if info.mesh.watertight else "not watertight")
            )
            for number, warning in enumerate(info.mesh.warnings, start=1):
                rows[f"mesh warning {number}"] = warning
        if info.convex_parts is not None:
            rows["convex parts"] = f"{info.convex_parts.parts}"
        rows["trials"] = f"{info.trials:,}"
        if info.outcomes:
            rows["outcomes"] = ", ".join(f"{n:,} {name}" for name, n in info.outcomes.items())
        rows["revision"] = str(info.revision)
        return rows

    def __repr__(self) -> str:
        info = self.info
        return (
            f"GraspObject({info.id!r}, trials={info.trials}, successes={info.outcomes.get('success', 0)}, "
            f"mesh={'yes' if info.mesh else 'no'}, revision={info.revision})"
        )

    def _repr_html_(self) -> str:
        return table_html(f"Object {self.info.name or self.info.id}", self.summary())


class Objects:
    """``db.objects``: create, find, list and delete objects."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def create(
        self,
        id: str,
        *,
        mesh: MeshLike | None = None,
        unit: str = "m",
        media_type: str | None = None,
        convex_parts: MeshLike | Sequence[Any] | None = None,
        name: str | None = None,
        mass_kg: float | None = None,
        density_kg_m3: float | None = None,
        friction: float | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> GraspObject:
        """Create an object, with its mesh and convex parts if given: all of it or nothing.

        ``id`` is a slug; ``mesh``, ``unit`` and ``media_type`` as in :meth:`GraspObject.upload_mesh`,
        ``convex_parts`` as in :meth:`GraspObject.upload_convex_parts`.

        Raises
        ------
        Conflict
            If an object has this id already.
        InvalidInput
            If a property or the mesh is refused.
        """
        fields = {
            "id": id,
            "name": name,
            "mass_kg": mass_kg,
            "density_kg_m3": density_kg_m3,
            "friction": friction,
            "metadata": metadata,
        }
        request = checked(wire.ObjectCreate, fields)
        loaded = None if mesh is None else read_mesh(mesh, media_type)
        answer = self._transport.json("POST", "/objects", body=request, idempotent=True)
        created = GraspObject(self._transport, wire.ObjectInfo.model_validate(answer))
        try:
            if loaded is not None:
                created.upload_mesh(loaded[0], unit=unit, media_type=loaded[1])
            if convex_parts is not None:
                created.upload_convex_parts(convex_parts)
        except (GraspDBError, OSError, ValueError, TypeError, ImportError):
            created.delete()
            raise
        return created

    def get(self, id: str) -> GraspObject:
        """The object with this id."""
        answer = self._transport.json("GET", f"/objects/{segment(id)}")
        return GraspObject(self._transport, wire.ObjectInfo.model_validate(answer))

    def list(self) -> Iterator[GraspObject]:
        """All objects."""
        for info in Listing(self._transport, "/objects", wire.ObjectInfo):
            yield GraspObject(self._transport, info)

    def __iter__(self) -> Iterator[GraspObject]:
        return self.list()

    def delete(self, id: str) -> None:
        """Delete an object with everything that belongs to it."""
        self._transport.request("DELETE", f"/objects/{segment(id)}")


def _patch(changes: Mapping[str, Any]) -> Mapping[str, Any]:
    """Nulls are meant in a patch, so it is checked without dropping them."""
    checked(wire.ObjectPatch, changes)
    return dict(changes)


def _numbers(name: str, values: ArrayLike | None, count: int, what: str) -> list[float] | None:
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count,):
        raise ValueError(f"{name} has shape {array.shape}; expected {count} numbers: {what}")
    numbers: list[float] = array.tolist()
    return numbers


def _rows(name: str, values: ArrayLike | None, count: int, what: str) -> list[list[float]] | None:
    if values is None:
        return None
    array = np.asarray(values, dtype=np.float64)
    array = array[None] if array.ndim == 1 and array.size else array
    if array.size and (array.ndim != 2 or array.shape[1] != count):
        raise ValueError(f"{name} has shape {array.shape}; expected rows of {count} numbers: {what}")
    rows: list[list[float]] = array.reshape(-1, count).tolist()
    return rows


def _pose_columns(poses: ArrayLike | Any | None) -> dict[str, Any] | None:
    if poses is None:
        return None
    position, quaternion = as_poses(poses)
    return {"position": position.tolist(), "quaternion_xyzw": quaternion.tolist()}


def _obstacles(obstacles: wire.Obstacles | Mapping[str, Any] | None) -> Any:
    """Points may be an array."""
    if obstacles is None or isinstance(obstacles, wire.Obstacles):
        return obstacles
    points = {"points": _rows("points", obstacles["points"], 3, "x, y, z")} if "points" in obstacles else {}
    return {**obstacles, **points}
