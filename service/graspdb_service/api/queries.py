"""Questions to an object's density: ``/objects/{id}/density``, likelihood, best-grasp, samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, TypeVar

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel

from graspdb.wire import (
    BestGraspRequest,
    BestGrasps,
    DensityInfo,
    EstimatorInfo,
    KernelInfo,
    LikelihoodRequest,
    Likelihoods,
    Proposals,
    ProposalsRequest,
    ReachInfo,
    Samples,
    SamplesRequest,
    Selection,
)
from graspdb.wire.queries import (
    MAX_OBSTACLE_POINTS,
    BestGraspQuery,
    LikelihoodOptions,
    LikelihoodQuery,
    SelectionQuery,
)
from graspdb_density.se3 import Poses
from graspdb_service.api.context import Context
from graspdb_service.api.routing.caching import answer_tag, not_modified
from graspdb_service.api.routing.parameters import Ctx, ObjectId, RawBody
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.columns import columns_arrow, columns_json
from graspdb_service.formats.json_bodies import read_object, validated
from graspdb_service.formats.negotiation import ARROW, BINARY, JSON, accepted, media_type
from graspdb_service.formats.poses import read_arrow_poses, read_poses
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.info import density_info
from graspdb_service.usecases.grasps import likelihood, proposals, samples
from graspdb_service.usecases.grasps.answer import best_grasps

router = APIRouter(tags=["queries"])

Q = TypeVar("Q", bound=Selection)


@router.get("/objects/{id}/density", response_model=DensityInfo, **scope("read"))
def get_density(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[SelectionQuery, Query()]
) -> Response:
    """The density of a selection of trials: kernel, widths and their rule, counts, effective sample size."""

    def answer(query: SelectionQuery) -> Response:
        info, selected = density_info(ctx, id, query)
        return _json(info, answer_tag(selected, info.revision, query))

    return _unless_known(ctx, id, request, query, answer)


@router.get("/objects/{id}/likelihood", response_model=Likelihoods, **scope("read"))
def get_likelihood(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[LikelihoodQuery, Query()]
) -> Response:
    """How likely one grasp is; columns of length one."""
    pose = Poses(np.array([query.position]), np.array([query.quaternion_xyzw]))

    def answer(query: LikelihoodQuery) -> Response:
        built, reach, columns = likelihood.likelihood(ctx, id, query, pose, query.include)
        tag = answer_tag(built.selected, built.revision, query)
        return columns_json(_likelihood_head(built, reach), columns, {"ETag": tag})

    return _unless_known(ctx, id, request, query, answer)


@router.post(
    "/objects/{id}/likelihood",
    response_model=Likelihoods,
    responses={200: {"content": {ARROW: {"schema": BINARY}}}},
    **scope("read", body={"application/json": LikelihoodRequest, ARROW: BINARY}),
)
def post_likelihood(ctx: Ctx, id: ObjectId, request: Request, body: RawBody) -> Response:
    """How likely each of many grasps is: columns in the poses' order.

    As an Arrow stream (`application/vnd.apache.arrow.stream`, by Content-Type and by Accept) the poses are
    the columns `position` and `quaternion_xyzw`, and the rest of the request JSON in the schema's metadata
    (key `graspdb`), as is the rest of the answer.
    """
    kind = accepted(request, JSON, ARROW)
    if media_type(request) == ARROW:
        content, poses = read_arrow_poses(body)
        options = validated(content, LikelihoodOptions)
    else:
        content = read_object(request, body)
        given = content.pop("poses", None)
        options = validated(content, LikelihoodOptions)
        poses = read_poses(given)
    built, reach, columns = likelihood.likelihood(ctx, id, options, poses, options.include)
    form = columns_arrow if kind == ARROW else columns_json
    return form(_likelihood_head(built, reach), columns, {"Vary": "Accept"})


@router.get("/objects/{id}/best-grasp", response_model=BestGrasps, **scope("read"))
def get_best_grasp(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[BestGraspQuery, Query()]
) -> Response:
    """The best distinct grasps in a workspace; all constraints in ``frame`` (world given ``object_pose``)."""

    def answer(query: BestGraspQuery) -> Response:
        best, selected = best_grasps(ctx, id, query)
        return _json(best, answer_tag(selected, best.revision, query))

    return _unless_known(ctx, id, request, query, answer)


@router.post(
    "/objects/{id}/best-grasp",
    response_model=BestGrasps,
    **scope("read", body={"application/json": BestGraspRequest}),
)
def post_best_grasp(ctx: Ctx, id: ObjectId, request: Request, body: RawBody) -> Response:
    """As GET, the constraints as JSON; also half spaces, obstacles, candidates and poses to exclude."""
    query = validated(read_object(request, body), BestGraspRequest, most=MAX_OBSTACLE_POINTS)
    answer, _ = best_grasps(ctx, id, query)
    return _json(answer)


@router.post("/objects/{id}/samples", response_model=Samples, **scope("read"))
def post_samples(ctx: Ctx, id: ObjectId, query: SamplesRequest) -> Response:
    """Draw grasps; sent back with the trial, ``proposal_density`` weights it. A seed makes it repeatable."""
    drawn = samples.draw(ctx, id, query, query.count, query.seed)
    return _drawn(drawn, {})


@router.post("/objects/{id}/proposals", response_model=Proposals, **scope("read"))
def post_proposals(ctx: Ctx, id: ObjectId, query: ProposalsRequest) -> Response:
    """Grasps to try next; sent back with the trial, ``proposal_density`` weights it.

    ``density`` draws where successes lie, ``uncertainty`` where one more trial teaches most. ``edges`` needs
    no trial, but a mesh and a gripper: it draws about grasps that close on opposed surfaces, edges or points
    no farther apart than the jaw opens, at any angle about the closing axis, by default with 10 mm and 15
    degrees. Grasps at which the open gripper collides are left out before; what is drawn about the others is
    not tested, for then the density would not be the one it was drawn with.
    """
    drawn, criterion = proposals.propose(ctx, id, query)
    return _drawn(drawn, {"strategy": query.strategy, "criterion": criterion})


def _drawn(drawn: samples.Draw, more: dict[str, Any]) -> Response:
    return columns_json(
        {
            **_head(drawn.revision, drawn.kernel, drawn.warnings),
            "seed": drawn.seed,
            "prior": drawn.prior,
            **more,
        },
        drawn.columns(),
    )


def _likelihood_head(built: Built, reach: ReachInfo | None) -> dict[str, Any]:
    head = _head(built.revision, built.kernel, built.selected.warnings)
    return head if reach is None else {**head, "reach": reach.model_dump()}


def _head(revision: int, kernel: KernelInfo, warnings: Sequence[str]) -> dict[str, Any]:
    head = {"revision": revision, "kernel": kernel.model_dump(), "estimator": EstimatorInfo().model_dump()}
    return {**head, "warnings": list(warnings)}


def _json(answer: BaseModel, tag: str | None = None) -> Response:
    return Response(
        answer.model_dump_json(), media_type="application/json", headers={} if tag is None else {"ETag": tag}
    )


def _unless_known(
    ctx: Context, slug: str, request: Request, query: Q, answer: Callable[[Q], Response]
) -> Response:
    """The answer to a query, or 304 where the client has that of this revision already."""
    selections = ctx.densities.selections
    if query.kernel == "anisotropic":
        # Pinned to the newest kernel, by its id: another kernel makes another answer and another ETag.
        newest = ctx.densities.stored(selections.resolve(slug, query), "anisotropic")
        query = query.model_copy(update={"kernel": newest.id})
    seen = None
    if "if-none-match" in request.headers:
        selected = selections.resolve(slug, query)
        seen = not_modified(request, answer_tag(selected, selected.row.revision, query))
    return answer(query) if seen is None else seen
