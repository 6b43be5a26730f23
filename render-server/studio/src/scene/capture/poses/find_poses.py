"""Estimates camera poses of pictures with pycolmap. `vizflyt scene capture` runs this script.

    python find_poses.py IMAGES PAIRS FOLDER MODELS LENS PARAMETERS

IMAGES is the folder of the pictures. PAIRS is a file with two names per line. The database is written to FOLDER, and
each model to a folder MODELS/0, MODELS/1, ... LENS is a camera model of COLMAP. PARAMETERS are its numbers, separated
by commas, or '' to estimate them.
"""

import sys

import pycolmap


def main(images: str, pairs: str, folder: str, models: str, lens: str, parameters: str) -> None:
    # The same pictures give the same poses.
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
    # Progress is printed per block.
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
