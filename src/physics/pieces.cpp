#include "pieces.h"

#include <BulletCollision/BroadphaseCollision/btCollisionAlgorithm.h>
#include <BulletCollision/CollisionDispatch/btCollisionObjectWrapper.h>
#include <BulletCollision/CollisionDispatch/btManifoldResult.h>
#include <BulletCollision/CollisionDispatch/btSimulationIslandManager.h>
#include <BulletCollision/NarrowPhaseCollision/btGjkEpaPenetrationDepthSolver.h>
#include <BulletCollision/NarrowPhaseCollision/btGjkPairDetector.h>
#include <BulletCollision/NarrowPhaseCollision/btPersistentManifold.h>
#include <BulletCollision/NarrowPhaseCollision/btPolyhedralContactClipping.h>
#include <BulletCollision/NarrowPhaseCollision/btVoronoiSimplexSolver.h>
#include <BulletCollision/CollisionShapes/btConvexPolyhedron.h>
#include <BulletCollision/CollisionShapes/btPolyhedralConvexShape.h>
#include <BulletDynamics/Featherstone/btMultiBody.h>
#include <BulletDynamics/Featherstone/btMultiBodyLinkCollider.h>

extern btScalar gContactBreakingThreshold;
extern bool gContactCalcArea3Points;

namespace iwgnet_grasp::physics {
namespace {

bool apart(const btVector3& d, const btVector3& reach) {
  return btFabs(d.x()) > reach.x() || btFabs(d.y()) > reach.y() || btFabs(d.z()) > reach.z();
}

constexpr double kNear = 0.002;         // m: pairs of pieces closer than this are looked at each step
constexpr double kSameNormal = 0.8;     // cosine: contacts within it share a patch
constexpr std::size_t kPatches = 6;     // patches of contact between two bodies
constexpr double kFacing = 0.995;       // cosine (6 deg): a face lies against a face
constexpr double kLargerArea = 1.1;     // squared area a fifth point must add to replace another

// What a query of two pieces found: the closest point first.
struct Touches : btDiscreteCollisionDetectorInterface::Result {
  struct Point {
    btVector3 normal, point;  // on b, world
    btScalar distance;        // m, negative: penetration
  };
  static constexpr int kMost = 16;
  Point points[kMost];
  int count = 0;
  btScalar offset = 0.0;  // m, to be added to reported distances

  void setShapeIdentifiersA(int, int) override {}
  void setShapeIdentifiersB(int, int) override {}
  void addContactPoint(const btVector3& n, const btVector3& p, btScalar d) override {
    if (count < kMost) points[count++] = {n, p, d + offset};
  }
};

// Squared extent of the quadrilateral of four points in any order (as Bullet measures it).
btScalar extent(const btVector3& p0, const btVector3& p1, const btVector3& p2,
                const btVector3& p3) {
  const btScalar a = (p0 - p1).cross(p2 - p3).length2();
  const btScalar b = (p0 - p2).cross(p1 - p3).length2();
  const btScalar c = (p0 - p3).cross(p1 - p2).length2();
  return btMax(a, btMax(b, c));
}

class PiecesAlgorithm : public btCollisionAlgorithm {
 public:
  PiecesAlgorithm(const btCollisionAlgorithmConstructionInfo& info)
      : btCollisionAlgorithm(info) {}
  ~PiecesAlgorithm() override {
    for (auto* patch : patches_) m_dispatcher->releaseManifold(patch);
  }

  void processCollision(const btCollisionObjectWrapper* a, const btCollisionObjectWrapper* b,
                        const btDispatcherInfo&, btManifoldResult* result) override {
    const auto& pieces_a = static_cast<const PiecesShape*>(a->getCollisionShape())->pieces();
    const auto& shape_b = *static_cast<const PiecesShape*>(b->getCollisionShape());
    const auto& pieces_b = shape_b.pieces();
    const btTransform &Ta = a->getWorldTransform(), &Tb = b->getWorldTransform();
    const btTransform T_a_b = Ta.inverseTimes(Tb);
    const btScalar slack = gContactBreakingThreshold;
    turn_normals(Tb.getBasis());

    if (!listed_ || moved(T_a_b, shape_b.radius()) > kNear) {
      list_pairs(pieces_a, pieces_b, T_a_b, slack + kNear);
      for (Pair& pair : pairs_) {
        Touches touches;
        query(pieces_a[pair.a], Ta, pieces_b[pair.b], Tb, slack + kNear, pair.axis, touches);
        pair.near = touches.count > 0;
      }
      T_listed_ = T_a_b;
      listed_ = true;
    }
    // Rubber lies along an edge as well, however its faces are inclined to the contact.
    const bool soft = (a->getCollisionObject()->getCollisionFlags() |
                       b->getCollisionObject()->getCollisionFlags()) &
                      btCollisionObject::CF_HAS_CONTACT_STIFFNESS_DAMPING;
    const btScalar facing_needed = soft ? -1.0 : kFacing;
    for (Pair& pair : pairs_) {
      if (!pair.near) continue;
      Touches touches;
      query(pieces_a[pair.a], Ta, pieces_b[pair.b], Tb, slack, pair.axis, touches);
      if (touches.count > 0)
        clip_faces(pieces_a[pair.a], Ta, pieces_b[pair.b], Tb, slack, facing_needed, touches);
      for (int k = 0; k < touches.count; ++k) admit(touches.points[k], a, b, *result);
    }
    for (auto* patch : patches_) {
      result->setPersistentManifold(patch);
      result->refreshContactPoints();
    }
  }

  btScalar calculateTimeOfImpact(btCollisionObject*, btCollisionObject*, const btDispatcherInfo&,
                                 btManifoldResult*) override {
    return 1.0;
  }
  void getAllContactManifolds(btManifoldArray& manifolds) override {
    for (auto* patch : patches_) manifolds.push_back(patch);
  }

 private:
  struct Pair {
    int a, b;
    bool near;
    btVector3 axis;  // from b to a in a's frame: along it the two were last seen apart
  };

  // Cached points keep their normal in the world, and an anchored one is not replaced while it
  // holds: without this the normals of a grip would stay behind when the gripper turns.
  void turn_normals(const btMatrix3x3& rotation) {
    const btMatrix3x3 turn = rotation * rotation_.transpose();
    for (auto* patch : patches_)
      for (int i = 0; i < patch->getNumContacts(); ++i) {
        btVector3& normal = patch->getContactPoint(i).m_normalWorldOnB;
        normal = (turn * normal).normalized();
      }
    rotation_ = rotation;
  }

  // Bound on the motion of any point of b as seen from a since the pairs were listed.
  btScalar moved(const btTransform& T_a_b, btScalar radius) const {
    btScalar turn = 0.0;
    for (int r = 0; r < 3; ++r)
      turn += (T_a_b.getBasis()[r] - T_listed_.getBasis()[r]).length2();
    return (T_a_b.getOrigin() - T_listed_.getOrigin()).length() + btSqrt(turn) * radius;
  }

  // Pairs of pieces whose bounds, widened by `reach`, meet in both bodies' axes.
  void list_pairs(const std::vector<PiecesShape::Piece>& pieces_a,
                  const std::vector<PiecesShape::Piece>& pieces_b, const btTransform& T_a_b,
                  btScalar reach) {
    const btTransform T_b_a = T_a_b.inverse();
    const btMatrix3x3 abs_a_b = T_a_b.getBasis().absolute(), abs_b_a = abs_a_b.transpose();
    const btVector3 margin(reach, reach, reach);
    std::vector<Pair> before;
    before.swap(pairs_);
    std::size_t k = 0;  // `before` is in the same order
    for (int j = 0; j < static_cast<int>(pieces_b.size()); ++j) {
      const auto& pb = pieces_b[j];
      const btVector3 center_b = T_a_b * pb.center;
      const btVector3 half_b = abs_a_b * pb.half + margin;
      for (int i = 0; i < static_cast<int>(pieces_a.size()); ++i) {
        const auto& pa = pieces_a[i];
        if (apart(center_b - pa.center, half_b + pa.half)) continue;
        if (apart(T_b_a * pa.center - pb.center, abs_b_a * pa.half + margin + pb.half)) continue;
        while (k < before.size() &&
               (before[k].b < j || (before[k].b == j && before[k].a < i)))
          ++k;
        const bool known = k < before.size() && before[k].b == j && before[k].a == i;
        pairs_.push_back({i, j, true, known ? before[k].axis : btVector3(0, 0, 0)});
      }
    }
  }

  static void query(const PiecesShape::Piece& a, const btTransform& Ta,
                    const PiecesShape::Piece& b, const btTransform& Tb, btScalar slack,
                    btVector3& axis, Touches& touches) {
    btDiscreteCollisionDetectorInterface::ClosestPointInput input;
    input.m_transformA = Ta * a.T_body_piece;
    input.m_transformB = Tb * b.T_body_piece;
    const btScalar reach = a.shape->getMargin() + b.shape->getMargin() + slack;
    if (!axis.fuzzyZero()) {
      const btVector3 world = Ta.getBasis() * axis;
      const btVector3 low = input.m_transformA * a.shape->localGetSupportingVertexWithoutMargin(
                                                     -world * input.m_transformA.getBasis());
      const btVector3 high = input.m_transformB * b.shape->localGetSupportingVertexWithoutMargin(
                                                      world * input.m_transformB.getBasis());
      if ((low - high).dot(world) > reach) return;
    }
    input.m_maximumDistanceSquared = reach * reach;
    btVoronoiSimplexSolver simplex;
    btGjkEpaPenetrationDepthSolver depth;
    btGjkPairDetector detector(a.shape.get(), b.shape.get(), &simplex, &depth);
    detector.getClosestPointsNonVirtual(input, touches, nullptr);
    const btVector3& found = detector.getCachedSeparatingAxis();
    const btScalar length = found.length();
    axis = length > SIMD_EPSILON ? (found / length) * Ta.getBasis() : btVector3(0, 0, 0);
  }

  // Cosine between a direction and the outward normal of the face that looks there most.
  static btScalar facing(const btConvexPolyhedron& polyhedron, const btTransform& T,
                         const btVector3& direction) {
    const btVector3 local = direction * T.getBasis();
    btScalar most = -1.0;
    for (int k = 0; k < polyhedron.m_faces.size(); ++k) {
      const btScalar* plane = polyhedron.m_faces[k].m_plane;
      most = btMax(most, plane[0] * local.x() + plane[1] * local.y() + plane[2] * local.z());
    }
    return most;
  }

  // The closest point alone holds no face against a face: the same pose gives the same point. Adds
  // the corners of the area that the two faces share.
  void clip_faces(const PiecesShape::Piece& a, const btTransform& Ta, const PiecesShape::Piece& b,
                  const btTransform& Tb, btScalar slack, btScalar facing_needed, Touches& touches) {
    if (!a.polyhedron || !b.polyhedron) return;
    const Touches::Point closest = touches.points[0];
    // Where edges or corners meet no area is shared, and the closest point says all.
    if (facing(*a.polyhedron, Ta * a.T_body_piece, -closest.normal) < facing_needed ||
        facing(*b.polyhedron, Tb * b.T_body_piece, closest.normal) < facing_needed)
      return;
    const btScalar margins = a.polyhedron_margin + b.polyhedron_margin;
    touches.offset = -margins;
    btPolyhedralContactClipping::clipHullAgainstHull(
        closest.normal, *a.polyhedron, *b.polyhedron, Ta * a.T_body_piece, Tb * b.T_body_piece,
        closest.distance + margins, slack + margins, vertices_, more_vertices_, touches);
    for (int k = 1; k < touches.count; ++k)  // from the polyhedron's face to the rounded surface
      touches.points[k].point += b.polyhedron_margin * closest.normal;
  }

  // The patch that a contact belongs to: one of a like normal, else a fresh one.
  btPersistentManifold* patch_for(const btVector3& normal, const btCollisionObjectWrapper* a,
                                  const btCollisionObjectWrapper* b) {
    btPersistentManifold *best = nullptr, *empty = nullptr;
    btScalar likeness = -2.0;
    for (auto* patch : patches_) {
      if (patch->getNumContacts() == 0) {
        if (!empty) empty = patch;
        continue;
      }
      const btScalar cosine = patch->getContactPoint(0).m_normalWorldOnB.dot(normal);
      if (cosine > likeness) {
        likeness = cosine;
        best = patch;
      }
    }
    if (best && likeness > kSameNormal) return best;
    if (empty) return empty;
    if (patches_.size() == kPatches) return best;
    patches_.push_back(
        m_dispatcher->getNewManifold(a->getCollisionObject(), b->getCollisionObject()));
    return patches_.back();
  }

  // Bullet lets a fifth point always replace one of four, which makes resting bodies shiver:
  // admit it only when it renews one of them, widens the patch or is the deepest. Points of pressing
  // pieces and of pieces that are merely near share a patch: the former must not be crowded out.
  void admit(const Touches::Point& touch, const btCollisionObjectWrapper* a,
             const btCollisionObjectWrapper* b, btManifoldResult& result) {
    btPersistentManifold* patch = patch_for(touch.normal, a, b);
    if (patch->getNumContacts() == MANIFOLD_CACHE_SIZE) {
      btVector3 p[MANIFOLD_CACHE_SIZE];
      bool renews = false;
      int deepest = -1, shallow = 0;
      btScalar shallowest = -1.0;
      btScalar depth = touch.distance;
      for (int k = 0; k < MANIFOLD_CACHE_SIZE; ++k) {
        const btManifoldPoint& point = patch->getContactPoint(k);
        p[k] = point.getPositionWorldOnB();
        renews = renews || (p[k] - touch.point).length() < patch->getContactBreakingThreshold();
        if (point.getDistance() > shallowest) {
          shallowest = point.getDistance();
          shallow = k;
        }
        if (point.getDistance() < depth) {
          depth = point.getDistance();
          deepest = k;
        }
      }
      if (!renews && shallowest > 0.0 && touch.distance < 0.0) {
        patch->removeContactPoint(shallow);  // what presses goes before what is only near
      } else if (!renews && touch.distance > 0.0 && depth < 0.0) {
        return;
      } else if (!renews) {
        const btScalar now = extent(p[0], p[1], p[2], p[3]);
        btScalar best = 0.0;
        for (int k = 0; k < MANIFOLD_CACHE_SIZE; ++k) {
          if (k == deepest) continue;
          const btVector3 kept = p[k];
          p[k] = touch.point;
          best = btMax(best, extent(p[0], p[1], p[2], p[3]));
          p[k] = kept;
        }
        if (best < kLargerArea * now) return;
      }
    }
    result.setPersistentManifold(patch);
    result.addContactPoint(touch.normal, touch.point, touch.distance);
  }

  std::vector<btPersistentManifold*> patches_;
  std::vector<Pair> pairs_;
  btVertexArray vertices_, more_vertices_;  // scratch
  bool listed_ = false;
  btTransform T_listed_;
  btMatrix3x3 rotation_ = btMatrix3x3::getIdentity();  // of b in the step before
};

struct CreatePiecesAlgorithm : btCollisionAlgorithmCreateFunc {
  btCollisionAlgorithm* CreateCollisionAlgorithm(btCollisionAlgorithmConstructionInfo& info,
                                                 const btCollisionObjectWrapper*,
                                                 const btCollisionObjectWrapper*) override {
    void* memory = info.m_dispatcher1->allocateCollisionAlgorithm(sizeof(PiecesAlgorithm));
    return new (memory) PiecesAlgorithm(info);
  }
};

btDefaultCollisionConstructionInfo pool_info() {
  btDefaultCollisionConstructionInfo info;
  info.m_customCollisionAlgorithmMaxElementSize = sizeof(PiecesAlgorithm);
  return info;
}

}  // namespace

void PiecesShape::add(std::unique_ptr<btConvexInternalShape> shape,
                      const btTransform& T_body_piece) {
  btVector3 low, high;
  shape->getAabb(T_body_piece, low, high);
  addChildShape(T_body_piece, shape.get());
  const btVector3 center = (low + high) / 2, half = (high - low) / 2;
  radius_ = btMax(radius_, center.length() + half.length());
  Piece piece{nullptr, T_body_piece, center, half};
  if (shape->isPolyhedral()) {
    auto& polyhedral = static_cast<btPolyhedralConvexShape&>(*shape);
    polyhedral.initializePolyhedralFeatures();
    piece.polyhedron = polyhedral.getConvexPolyhedron();
    // A box's corners include its margin, a hull's points do not.
    const bool box = shape->getShapeType() == BOX_SHAPE_PROXYTYPE;
    piece.polyhedron_margin = box ? 0.0 : shape->getMargin();
  }
  piece.shape = std::move(shape);
  pieces_.push_back(std::move(piece));
}

PiecesConfiguration::PiecesConfiguration()
    : btDefaultCollisionConfiguration(pool_info()),
      create_(std::make_unique<CreatePiecesAlgorithm>()) {
  gContactCalcArea3Points = false;  // judge points as extent() does
}

btCollisionAlgorithmCreateFunc* PiecesConfiguration::getCollisionAlgorithmCreateFunc(int type_a,
                                                                                     int type_b) {
  if (type_a == COMPOUND_SHAPE_PROXYTYPE && type_b == COMPOUND_SHAPE_PROXYTYPE)
    return create_.get();
  return btDefaultCollisionConfiguration::getCollisionAlgorithmCreateFunc(type_a, type_b);
}

void ContactIslandWorld::calculateSimulationIslands() {
  btSimulationIslandManager& islands = *getSimulationIslandManager();
  int moving = 0;
  for (int i = 0; i < getNumCollisionObjects(); ++i) {
    btCollisionObject* object = getCollisionObjectArray()[i];
    if (!object->isStaticOrKinematicObject()) object->setIslandTag(moving++);
    object->setCompanionId(-1);
    object->setHitFraction(1.0);
  }
  islands.initUnionFind(moving);
  const auto unite = [&](const btCollisionObject* a, const btCollisionObject* b) {
    if (a && b && !a->isStaticOrKinematicObject() && !b->isStaticOrKinematicObject())
      islands.getUnionFind().unite(a->getIslandTag(), b->getIslandTag());
  };
  for (int i = 0; i < getDispatcher()->getNumManifolds(); ++i) {
    const btPersistentManifold* manifold = getDispatcher()->getManifoldByIndexInternal(i);
    if (manifold->getNumContacts() > 0) unite(manifold->getBody0(), manifold->getBody1());
  }
  for (int k = 0; k < getNumMultibodies(); ++k) {
    const btMultiBody* body = getMultiBody(k);
    const btCollisionObject* first = nullptr;
    for (int l = 0; l < body->getNumLinks(); ++l) {
      const btCollisionObject* link = body->getLink(l).m_collider;
      unite(first, link);
      if (!first) first = link;
    }
  }
  islands.storeIslandActivationState(getCollisionWorld());
}

}  // namespace iwgnet_grasp::physics
