"""Collisions of an arm with itself and its surroundings, by the collision models of Pinocchio and Coal.

The shapes are the <collision> elements of the URDF. A mesh is replaced by its convex hull: signed distances of convex
shapes are exact and have a gradient. The hull contains the mesh, so that no contact is overlooked.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil

import coal
import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.pinocchio_arm import kinematic_model
from spelgen.dynamics.tip_frame import body_constraint, link_poses
from spelgen.excitation.bounds import MotionBounds, Surroundings
from spelgen.excitation.trajectory import Motion
from spelgen.excitation.tuning import TUNING
from spelgen.labels import counted
from spelgen.urdf.geometry import LinkShape, link_shapes

FLOOR = "the floor"


@dataclass(frozen=True)
class Contact:
    """Contact of two objects during a motion.

    time: first time at which the objects are closer than the clearance [s]. distance: signed distance at this time [m],
    negative for overlapping shapes. first, second: names of the objects.
    """

    time: float
    distance: float
    first: str
    second: str

    def __str__(self) -> str:
        return f"{self.first} and {self.second} at {self.time:.2f} s ({1e3 * self.distance:.0f} mm)"


class Collisions:
    """Signed distances of the links of an arm to each other, and to floor and boxes; negative for overlapping shapes.

    The objects are the collision shapes of the links, the floor and the boxes. Links of the same body, or of two bodies
    connected by a joint, are not compared, because their shapes overlap.

    Attributes:
        clearance: Smallest allowed distance [m].
        unread: Names of the links whose shapes cannot be read.
        ignored: Pairs of objects that are not compared, because they are too close at nearly all random positions.
    """

    def __init__(self, arm: Arm, surroundings: Surroundings, bounds: MotionBounds) -> None:
        """Add the collision shapes of all objects, and select the pairs of objects whose distances are computed.

        bounds: position limits of the joints. Pairs that are too close at nearly all random positions within these
        limits are not compared (``ignored``). The limits of prismatic joints also bound the length of the arm, from
        which the largest displacement of a point of the arm is computed. Raises LookupError if the URDF has no
        collision shape that can be read.
        """
        robot, chain, self.clearance = arm.robot, arm.chain, surroundings.clearance
        shapes = link_shapes(robot.path, "collision", [link.name for link in robot.links], TUNING.faces)
        self.unread = shapes.unread_text
        if self.unread and not shapes.shapes:
            raise LookupError(f"no collision shape can be read: {self.unread}")
        if not shapes.shapes:
            raise LookupError("the URDF has no collision geometry")
        self._model, self._constraint = kinematic_model(chain), body_constraint(chain)
        self._geometry = pin.GeometryModel()
        self._names: list[str] = []  # The name of each object.
        self._bodies: list[int] = []  # The index of the body that carries each object; -1 is the root link.
        # Radius of each body, (bodies,) [m]: largest distance between a point of its shapes and the origin of its
        # frame.
        self._extents = np.zeros(len(chain.bodies))
        poses = link_poses(arm, arm.angle_tolerance)
        for shape in shapes.shapes:
            body, pose = poses[shape.link]
            self._add(shape.link, body, pose @ shape.pose, _geometry(shape))
        links = len(self._bodies)
        if surroundings.floor is not None:
            self._add(FLOOR, -1, np.eye(4), coal.Halfspace(np.array([0.0, 0.0, 1.0]), surroundings.floor))
        for name, box in surroundings.boxes.items():
            pose = pin.SE3(pin.rpy.rpyToMatrix(*box.rpy), np.array(box.xyz)).homogeneous
            self._add(f"box {name!r}", -1, pose, coal.Box(*box.size))
        self._surroundings = " and surroundings" if len(self._bodies) > links else ""
        for first, second in self._pairs(chain, links):
            self._geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._displacement = self._largest_displacements(chain, bounds)
        self._data, self._found = self._model.createData(), pin.GeometryData(self._geometry)
        self.ignored = self._remove_overlapping(bounds, links)

    @property
    def pairs(self) -> int:
        """Number of pairs of objects whose distance is computed."""
        return len(self._geometry.collisionPairs)

    @property
    def statement(self) -> str:
        """Text for users that lists the pairs that are checked for collisions and the pairs that are not."""
        pairs = counted(self.pairs, "pair")
        clearance = f"approach included; all keep {1e3 * self.clearance:g} mm"
        text = "Not checked: collisions (there are no pairs of links whose shapes can be compared)."
        if self.pairs:
            text = f"Checked: {pairs} of links{self._surroundings}, {clearance}."
        if self.ignored:
            text += f" Not checked, since their shapes overlap in most positions: {', '.join(self.ignored)}."
        if self.unread:
            text += f" Not checked, since their shapes cannot be read: {self.unread}."
        return text

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the signed distance of each pair of objects, (pairs,) [m], at q (n,) [rad, m]."""
        positions = self._constraint.jacobian @ q + self._constraint.offset
        pin.computeDistances(self._model, self._data, self._geometry, self._found, positions)
        return np.array([result.min_distance for result in self._found.distanceResults])

    def contact(self, motion: Motion) -> Contact | None:
        """Return the first contact of a motion, a distance below the clearance; None if there is none.

        Distances are computed at selected positions of the motion. Between two successive selected positions, each
        point of the arm moves by at most 1.5 clearances relative to any object. In between, a distance is therefore at
        most 0.75 clearances smaller than at the nearer selected position. If all computed distances are at least the
        clearance, there is no collision.
        """
        lengths = np.abs(np.diff(motion.q, axis=0)) @ self._displacement
        path = np.concatenate([[0.0], np.cumsum(lengths)])
        # The selected positions are equidistant in path length and not in time, so that a slow motion needs no more
        # positions than a fast motion.
        points = np.linspace(0.0, path[-1], ceil(path[-1] / (1.5 * self.clearance)) + 1)
        for point in points:
            q = np.array([np.interp(point, path, column) for column in motion.q.T])
            contact = self.contact_at(q, float(np.interp(point, path, motion.t)))
            if contact is not None:
                return contact
        return None

    def contact_at(self, q: np.ndarray, time: float = 0.0) -> Contact | None:
        """Return the nearest pair of objects at q (n,) [rad, m]; None if its distance is not below the clearance.

        time: time at which the motion is at q [s], for the result.
        """
        distances = self.distances(q)
        nearest = int(distances.argmin()) if self.pairs else 0
        if not self.pairs or distances[nearest] >= self.clearance:
            return None
        return Contact(time, float(distances[nearest]), *self._names_of(nearest))

    def penalty(self, q: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the penalty on distances below a margin at positions q (T, n), and its gradient (T, n).

        The penalty is the sum over positions and pairs of max(0, 1 - distance / margin)^2. The margin is
        ``TUNING.margin`` times the clearance.
        """
        value, gradient, margin = 0.0, np.zeros_like(q), TUNING.margin * self.clearance
        for row, position in enumerate(q):
            distances = self.distances(position)
            close = np.flatnonzero(distances < margin).tolist()
            if close:
                positions = self._constraint.jacobian @ position + self._constraint.offset
                pin.computeJointJacobians(self._model, self._data, positions)
            for pair in close:
                violation = 1.0 - distances[pair] / margin
                value += violation**2
                gradient[row] -= 2 * violation / margin * self._distance_gradient(pair)
        return value, gradient

    def _distance_gradient(self, pair: int) -> np.ndarray:
        """Return the derivative of the signed distance of a pair with respect to q, (n,).

        ``distances`` and the joint Jacobians must have been computed at q.
        """
        result, objects = self._found.distanceResults[pair], self._geometry.collisionPairs[pair]
        gradient = np.zeros(self._model.nv)
        for index, point, sign in (
            (objects.first, result.getNearestPoint1(), -1.0),
            (objects.second, result.getNearestPoint2(), 1.0),
        ):
            joint = self._bodies[index] + 1
            if joint:
                frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
                jacobian = pin.getJointJacobian(self._model, self._data, joint, frame)
                # The derivative of the signed distance is the velocity of the nearest point of the second object
                # relative to the nearest point of the first, along the normal, which points from first to second.
                arm = np.cross(point - self._data.oMi[joint].translation, result.normal)
                gradient += sign * (result.normal @ jacobian[:3] + arm @ jacobian[3:])
        return np.asarray(gradient @ self._constraint.jacobian)

    def _add(self, name: str, body: int, pose: np.ndarray, geometry: coal.CollisionGeometry) -> None:
        """Add an object that is fixed to a body. pose: pose of the object in the frame of the body, (4, 4)."""
        placed = pin.GeometryObject(str(len(self._bodies)), body + 1, pin.SE3(pose), geometry)
        self._geometry.addGeometryObject(placed)
        self._bodies.append(body)
        self._names.append(name)
        if body >= 0:
            geometry.computeLocalAABB()
            center = pose[:3, :3] @ geometry.aabb_center + pose[:3, 3]
            extent = float(np.linalg.norm(center) + geometry.aabb_radius)
            self._extents[body] = max(self._extents[body], extent)

    def _names_of(self, pair: int) -> tuple[str, str]:
        """Return the names of the two objects of a pair."""
        objects = self._geometry.collisionPairs[pair]
        return self._names[objects.first], self._names[objects.second]

    def _pairs(self, chain: Chain, links: int) -> Iterator[tuple[int, int]]:
        """Yield the indices of the two objects of each pair whose distance is computed.

        Objects of the same body, and shapes of two bodies that a joint connects, form no pair. links: number of objects
        that are shapes of links; these objects are followed by the floor and the boxes.
        """
        neighbour = {}
        for index, body in enumerate(chain.bodies):
            # Shapes of a body and its parent overlap at the joint, so their distance is not computed. For a parent
            # without shapes, this applies to the next ancestor with a shape.
            parent = body.parent
            while parent >= 0 and parent not in self._bodies:
                parent = chain.bodies[parent].parent
            neighbour[index] = parent
        for k, second in enumerate(self._bodies):
            for index, first in enumerate(self._bodies[:k]):
                is_connected = neighbour.get(second) == first or neighbour.get(first) == second
                if first != second and (k >= links or not is_connected):
                    yield index, k

    def _largest_displacements(self, chain: Chain, bounds: MotionBounds) -> np.ndarray:
        """Return upper bounds w of the displacement of a point of the arm, (n,) [m/rad, 1].

        If joint k moves by dq, no point of the arm moves by more than w[k] |dq|. For a revolute joint, w[k] is the
        length of the chain beyond the joint.
        """
        extents, weights = self._extents.copy(), np.zeros(len(chain.coordinates))
        # A prismatic joint makes the chain longer by at most `travel`, (n,).
        travel = np.maximum(np.abs(bounds.low), np.abs(bounds.high))
        # Bodies are visited from the tip to the root, so that the extent of a body includes all bodies beyond it.
        for index, body in reversed(list(enumerate(chain.bodies))):
            k, ratio = body.coordinate, abs(float(body.multiplier))
            length = float(np.linalg.norm(np.array(body.translation, dtype=float)))
            if body.joint_type == "prismatic":
                length += ratio * travel[k] + abs(body.offset)
                weights[k] += ratio
            else:
                weights[k] += ratio * extents[index]
            if body.parent >= 0:
                extents[body.parent] = max(extents[body.parent], length + extents[index])
        return weights

    def _remove_overlapping(self, bounds: MotionBounds, links: int) -> tuple[str, ...]:
        """Remove pairs of objects that nearly always touch: their distances are not computed. Return their names.

        Objects are shapes of links, the floor and boxes. Shapes of links that always touch would exclude all motions.
        The positions of the test are random and within the bounds. links: number of shapes of links, the first objects.
        """
        generator = np.random.default_rng(0)
        random = generator.uniform(bounds.low, bounds.high, (TUNING.positions, len(bounds.low)))
        share = np.mean([self.distances(q) < self.clearance for q in random], axis=0)
        names: dict[str, None] = {}
        for pair in reversed(range(self.pairs)):
            objects = self._geometry.collisionPairs[pair]
            # `share` is the fraction of positions at which a pair is closer than the clearance. Two links are removed
            # at a share of at least `TUNING.overlap`, 95 %. A link and the floor, or a link and a box, are removed only
            # at 100 %, as for a base on the floor: at a smaller share, the motion must avoid the contact.
            if share[pair] >= (TUNING.overlap if objects.second < links else 1.0):
                names[" and ".join(self._names_of(pair))] = None
                self._geometry.removeCollisionPair(objects)
        self._found = pin.GeometryData(self._geometry)
        return tuple(reversed(names))


def _geometry(shape: LinkShape) -> coal.CollisionGeometry:
    """Return the Coal geometry of a shape; a mesh is replaced by its convex hull."""
    if shape.mesh is None:
        kinds = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere}
        return kinds[shape.kind](*shape.size)
    points = coal.StdVec_Vec3s()
    points.extend(list(shape.mesh[0]))
    # Options of Qhull: Qt makes triangular facets. QJ perturbs the vertices slightly, so that flat meshes have a hull.
    return coal.Convex.convexHull(points, False, "Qt QJ")
