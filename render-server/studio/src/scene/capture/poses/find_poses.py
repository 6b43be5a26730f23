"""Finds where pictures were taken from, by pycolmap; what `vizflyt scene capture` runs.

    python find_poses.py IMAGES PAIRS FOLDER MODELS LENS PARAMETERS

IMAGES is a folder; PAIRS a file with two names a line. FOLDER takes the database, MODELS a folder 0, 1, ... of each
model that was found. LENS is COLMAP's name of one, PARAMETERS its numbers with commas, or '' to find them.
"""

import sys

import pycolmap


def main(images: str, pairs: str, folder: str, models: str, lens: str, parameters: str) -> None:
    # The same pictures, the same poses.
    pycolmap.set_random_seed(1)
    database = folder + "/database.db"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = lens
    reader.camera_params = parameters
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = 4096
    single = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database, images, camera_mode=single, reader_options=reader, extraction_options=extraction
    )

    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    # Progress is told by blocks.
    pairing.block_size = 100
    pycolmap.match_image_pairs(database, pairing_options=pairing)

    mapping = pycolmap.IncrementalPipelineOptions()
    if parameters:
        mapping.ba_refine_focal_length = False
        mapping.ba_refine_extra_params = False
        mapping.mapper.abs_pose_refine_focal_length = False
        mapping.mapper.abs_pose_refine_extra_params = False
    pycolmap.incremental_mapping(database, images, models, mapping)


if __name__ == "__main__":
    main(*sys.argv[1:])
