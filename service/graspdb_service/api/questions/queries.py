"""Questions to an object's density: ``/objects/{id}/density``, likelihood, best-grasp, samples."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, TypeVar

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from graspdb.wire import (
    BestGraspRequest,
    BestGrasps,
    DensityInfo,
    LikelihoodRequest,
    Likelihoods,
    Proposals,
    ProposalsRequest,
    Samples,
    SamplesRequest,
    Selection,
)
from graspdb.wire.queries import (
    MAX_OBSTACLE_POINTS,
    BestGraspQuery,
    DensityQuery,
    LikelihoodOptions,
    LikelihoodQuery,
)
from graspdb_density.se3 import Poses
from graspdb_service.api.context import Context
from graspdb_service.api.routing.admission import AdmittedRoute
from graspdb_service.api.routing.caching import answer_tag, not_modified, seen_after
from graspdb_service.api.routing.parameters import Ctx, ObjectId, RawBody
from graspdb_service.api.routing.scopes import scope
from graspdb_service.formats.columns import columns_arrow
from graspdb_service.formats.json_bodies import read_object, validated
from graspdb_service.formats.negotiation import ARROW, BINARY, JSON, accepted, media_type
from graspdb_service.formats.poses import read_arrow_poses, read_poses
from graspdb_service.problems import invalid
from graspdb_service.usecases.answers import asking
from graspdb_service.usecases.answers.asking import Told
from graspdb_service.usecases.densities.info import density_info
from graspdb_service.usecases.runtime.asked import outage

router = APIRouter(tags=["queries"], route_class=AdmittedRoute)

Q = TypeVar("Q", bound=Selection)


@router.get("/objects/{id}/density", response_model=DensityInfo, **scope("read", work="queries"))
def get_density(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[DensityQuery, Query()]
) -> Response:
    """The density of a selection of trials: kernel, widths and their rule, counts, effective sample size."""

    def answer(query: DensityQuery) -> Response:
        info, selected = density_info(ctx, id, query)
        # Nobody knows what a stale answer would be today.
        headers = {} if info.stale else {"ETag": answer_tag(selected, info.revision, query)}
        return Response(info.model_dump_json(), media_type=JSON, headers=headers)

    return _unless_known(ctx, id, request, query, answer)


@router.get("/objects/{id}/likelihood", response_model=Likelihoods, **scope("read", work="queries"))
def get_likelihood(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[LikelihoodQuery, Query()]
) -> Response:
    """How likely one grasp is; columns of length one."""
    pose = Poses(np.array([query.position]), np.array([query.quaternion_xyzw]))

    def answer(query: LikelihoodQuery) -> Response:
        return _told(asking.likelihood(ctx, id, query, pose), query)

    return _unless_known(ctx, id, request, query, answer)


@router.post(
    "/objects/{id}/likelihood",
    response_model=Likelihoods,
    responses={200: {"content": {ARROW: {"schema": BINARY}}}},
    **scope("read", body={JSON: LikelihoodRequest, ARROW: BINARY}, work="queries", large=True),
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
    if kind == ARROW and options.name is not None:
        raise invalid("name", "an answer under a name comes as JSON: say so by Accept")
    told = asking.likelihood(ctx, id, options, poses)
    if kind == ARROW:
        return columns_arrow(told.head, told.columns, {"Vary": "Accept"})
    return Response(told.json, media_type=JSON, headers={"Vary": "Accept"})


@router.get("/objects/{id}/best-grasp", response_model=BestGrasps, **scope("read", work="queries"))
def get_best_grasp(
    ctx: Ctx, id: ObjectId, request: Request, query: Annotated[BestGraspQuery, Query()]
) -> Response:
    """The best distinct grasps in a workspace; all constraints in ``reference`` (world given
    ``object_pose``), and about the tool."""

    def answer(query: BestGraspQuery) -> Response:
        return _told(asking.best_grasps(ctx, id, query), query)

    return _unless_known(ctx, id, request, query, answer)


@router.post(
    "/objects/{id}/best-grasp",
    response_model=BestGrasps,
    **scope("read", body={JSON: BestGraspRequest}, work="queries", large=True),
)
def post_best_grasp(ctx: Ctx, id: ObjectId, request: Request, body: RawBody) -> Response:
    """As GET, the constraints as JSON; also half spaces, obstacles, candidates and poses to exclude."""
    query = validated(read_object(request, body), BestGraspRequest, most=MAX_OBSTACLE_POINTS)
    return _told(asking.best_grasps(ctx, id, query))


@router.post("/objects/{id}/samples", response_model=Samples, **scope("read", work="queries"))
def post_samples(ctx: Ctx, id: ObjectId, query: SamplesRequest) -> Response:
    """Draw grasps; sent back with the trial, ``proposal_density`` weights it. A seed makes it repeatable."""
    return _told(asking.draws(ctx, id, query))


@router.post("/objects/{id}/proposals", response_model=Proposals, **scope("read", work="queries"))
def post_proposals(ctx: Ctx, id: ObjectId, query: ProposalsRequest) -> Response:
    """Grasps to try next; sent back with the trial, ``proposal_density`` weights it.

    ``density`` draws where successes lie, ``uncertainty`` where one more trial teaches most. ``edges`` needs
    no trial, but a mesh and a gripper: it draws about grasps that close on opposed surfaces, edges or points
    no farther apart than the jaw opens, at any angle about the closing axis, by default with 10 mm and 15
    degrees. Grasps at which the open gripper collides are left out before; what is drawn about the others is
    not tested, for then the density would not be the one it was drawn with. ``expected_improvement`` draws
    about the grasps that are expected to raise the success probability of the best grasp within the bounds
    most, with 3 mm and 3 degrees where success probabilities have the default kernel: before any trial as
    well, where mesh and gripper are known. Bounds are those of best-grasp; other strategies refuse them.
    """
    return _told(asking.draws(ctx, id, query))


def _told(told: Told, query: Selection | None = None) -> Response:
    """An answer; tagged where it is one to a query, and kept."""
    tag = None
    if query is not None and told.selected is not None and told.id is not None:
        tag = answer_tag(told.selected, told.revision, query, told.id)
    return Response(told.json, media_type=JSON, headers={} if tag is None else {"ETag": tag})


def _unless_known(
    ctx: Context, slug: str, request: Request, query: Q, answer: Callable[[Q], Response]
) -> Response:
    """The answer to a query, or 304 where the client has that of this revision already.

    An answer with an id must still be kept under it, and one with a name is looked up by that.
    """
    selections = ctx.densities.selections
    if query.kernel == "anisotropic":
        # Pinned to the newest kernel, by its id: another kernel makes another answer and another ETag.
        newest = ctx.densities.stored(selections.resolve(slug, query), "anisotropic")
        query = query.model_copy(update={"kernel": newest.id})
    if "if-none-match" not in request.headers or getattr(query, "name", None) is not None:
        return answer(query)
    selected = selections.resolve(slug, query)
    if outage() is not None:
        return answer(query)
    tag = answer_tag(selected, selected.row.revision, query)
    kept = next((answer for answer in seen_after(request, tag) if ctx.answers.keeps(answer)), None)
    if kept is not None:
        tag = answer_tag(selected, selected.row.revision, query, kept)
    return not_modified(request, tag) or answer(query)
